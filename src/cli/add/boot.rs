// SPDX-License-Identifier: GPL-3.0-or-later
//! The boot loader's settings: which line of config.txt, or which overlay, enables a bus.

use std::collections::BTreeSet;

use super::board::Bus;
use super::splice::Splice;

/// The values with which config.txt switches a parameter on. None is also one.
const ON: [&str; 4] = ["on", "true", "yes", "1"];

/// The insertions into a config.txt so that all of `wanted` are on for a board to which these sections apply, each with
/// its line. Each has a section of its own, so that another device can keep it. `device` names the lines for a reader.
pub(super) fn config_txt(text: &str, sections: &[String], device: &str, wanted: &[&str]) -> Vec<(String, Splice)> {
    let end = if text.contains("\r\n") { "\r\n" } else { "\n" };
    let mut at = text.len();
    let mut before = if text.is_empty() || text.ends_with('\n') { "" } else { end };
    let mut splices = Vec::new();
    for line in wanted.iter().filter(|line| !is_on(text, sections, line)) {
        let new = format!("{before}# pinion add {device}{end}[all]{end}{line}{end}");
        before = "";
        splices.push(((*line).to_owned(), Splice::insert(at, new)));
        at += splices.last().map_or(0, |(_, splice)| splice.new.len());
    }
    splices
}

/// The line that a config.txt gives to 1-Wire, if it is not the overlay's own.
pub(super) fn w1_line(text: &str, sections: &[String]) -> Option<u32> {
    let lines = applying(text, sections);
    let overlay = lines.iter().rev().find_map(|line| line.strip_prefix("dtoverlay=w1-gpio,"))?;
    overlay.split(',').find_map(|parameter| parameter.trim().strip_prefix("gpiopin="))?.parse().ok()
}

/// The lines of a config.txt that apply. Sections whose condition is not known do not count.
fn applying<'a>(text: &'a str, sections: &[String]) -> Vec<&'a str> {
    let mut applies = true;
    let mut lines = Vec::new();
    for line in text.lines().map(str::trim) {
        match line.strip_prefix('[').and_then(|line| line.strip_suffix(']')) {
            Some(section) => applies = section == "all" || sections.iter().any(|own| own == section),
            None if applies && !line.starts_with('#') => lines.push(line),
            None => {}
        }
    }
    lines
}

/// Whether a config.txt has the effect of this line.
fn is_on(text: &str, sections: &[String], wanted: &str) -> bool {
    let lines = applying(text, sections);
    if let Some(wanted) = wanted.strip_prefix("dtparam=") {
        let (key, value) = wanted.split_once('=').unwrap_or((wanted, "on"));
        let settings = lines.iter().filter_map(|line| line.strip_prefix("dtparam=")).flat_map(|line| line.split(','));
        let mut settings = settings.map(|setting| setting.split_once('=').unwrap_or((setting, "on")));
        let last = settings.rfind(|(own, _)| parameter(own.trim()) == key);
        return last.is_some_and(|(_, own)| own.trim() == value || ON.contains(&own.trim()) && ON.contains(&value));
    }
    if let Some(overlay) = wanted.strip_prefix("dtoverlay=") {
        let own = lines.iter().filter_map(|line| line.strip_prefix("dtoverlay="));
        let name = |overlay: &str| overlay.split(',').next().unwrap_or_default().trim().to_owned();
        // The same overlay may load several devices, and then they differ by its parameters.
        return own.clone().any(|own| own == overlay)
            || !overlay.contains(',') && own.into_iter().any(|own| name(own) == overlay);
    }
    let (key, value) = wanted.split_once('=').unwrap_or((wanted, ""));
    let mut settings = lines.iter().filter_map(|line| line.split_once('='));
    settings.rfind(|(own, _)| own.trim() == key).is_some_and(|(_, own)| own.trim() == value)
}

/// A parameter of config.txt by its usual name. The others are in overlays/README.
fn parameter(name: &str) -> &str {
    match name {
        "i2c" | "i2c1" => "i2c_arm",
        "i2c_baudrate" | "i2c1_baudrate" => "i2c_arm_baudrate",
        name => name,
    }
}

/// The changes to an armbianEnv.txt or its like so that an overlay of this bus is loaded. `files` are the names of the
/// image's overlays, without `.dtbo`. Nothing if one is loaded already.
///
/// # Errors
///
/// One line: the image has none of the known overlays, or another one uses the same pins.
pub(super) fn overlays(text: &str, bus: &Bus, files: &BTreeSet<String>) -> Result<Vec<Splice>, String> {
    let loaded = last(text, "overlays").map(|(_, value)| value).unwrap_or_default();
    let prefix = last(text, "overlay_prefix").map(|(_, value)| value).unwrap_or_default();
    let is = |token: &str, name: &str| token == name || token == format!("{prefix}-{name}");
    let loaded: Vec<&str> = loaded.split_whitespace().collect();
    if let Some(other) = bus.excludes.iter().find(|other| loaded.iter().any(|token| is(token, other))) {
        return Err(format!("the overlay {other} uses {} already: remove it from overlays=", bus.node));
    }
    let is_loaded = |way: &&Vec<String>| {
        let (name, parameters) = way.split_first().map_or(("", &[][..]), |(name, rest)| (name.as_str(), rest));
        let set = |line: &String| {
            let (key, value) = line.split_once('=').unwrap_or((line, ""));
            last(text, key).is_some_and(|(_, own)| own == value)
        };
        loaded.iter().any(|token| is(token, name)) && parameters.iter().all(set)
    };
    if bus.overlays.iter().any(|way| is_loaded(&way)) {
        return Ok(Vec::new());
    }
    let has = |way: &&Vec<String>| {
        way.first().is_some_and(|name| files.contains(name) || files.contains(&format!("{prefix}-{name}")))
    };
    let Some((name, parameters)) = bus.overlays.iter().find(has).and_then(|way| way.split_first()) else {
        let kind = bus.node.trim_end_matches(|c: char| !c.is_alphabetic()).trim_end_matches("dev");
        let near: Vec<&str> = files.iter().map(String::as_str).filter(|file| file.contains(kind)).take(8).collect();
        return Err(match near[..] {
            [] => format!("this image has no overlay for {}: look for one in its documentation", bus.node),
            _ => format!(
                "none of the known overlays for {} is in this image, which has {}: write the right one into overlays=",
                bus.node,
                near.join(", ")
            ),
        });
    };
    let mut splices = add_word(text, "overlays", name);
    let mut changed = text.to_owned();
    splices.iter().for_each(|splice| splice.apply(&mut changed));
    for line in parameters {
        let (key, value) = line.split_once('=').unwrap_or((line, ""));
        let splice = set(&changed, key, value);
        splice.apply(&mut changed);
        splices.push(splice);
    }
    Ok(splices.into_iter().filter(|splice| splice.old != splice.new).collect())
}

/// The value of a key, from its last line, and where the value is. The boot loader imports the lines in order.
fn last<'a>(text: &'a str, key: &str) -> Option<(usize, &'a str)> {
    let mut at = 0;
    let mut found = None;
    for line in text.split_inclusive('\n') {
        if let Some(value) = line.strip_prefix(key).and_then(|rest| rest.strip_prefix('=')) {
            let value = value.trim_end();
            found = Some((at + key.len() + 1, value));
        }
        at += line.len();
    }
    found
}

/// Sets a key to a value.
fn set(text: &str, key: &str, value: &str) -> Splice {
    match last(text, key) {
        Some((at, old)) => {
            // With the key, the text is found again even if the file has changed above it.
            let at = at - key.len() - 1;
            Splice { at, old: format!("{key}={old}"), new: format!("{key}={value}"), word: None }
        }
        None => {
            let end = if text.contains("\r\n") { "\r\n" } else { "\n" };
            let before = if text.is_empty() || text.ends_with('\n') { "" } else { end };
            Splice::insert(text.len(), format!("{before}{key}={value}{end}"))
        }
    }
}

/// Adds a word to the value of a key. A line that is missing is a change of its own: it stays while another device has a
/// word in it.
fn add_word(text: &str, key: &str, word: &str) -> Vec<Splice> {
    let mut splices = Vec::new();
    let mut changed = text.to_owned();
    if last(text, key).is_none() {
        let line = set(text, key, "");
        line.apply(&mut changed);
        splices.push(line);
    }
    let words = last(&changed, key).map_or("", |(_, words)| words);
    let value = if words.is_empty() { word.to_owned() } else { format!("{words} {word}") };
    splices.push(Splice { word: Some(word.to_owned()), ..set(&changed, key, &value) });
    splices
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::add::catalog::{Catalog, Kind};
    use crate::cli::computer::tests::Tree;
    use proptest::prelude::*;

    const SPI: &[&str] = &["dtparam=spi=on"];

    fn with(text: &str, sections: &[&str], wanted: &[&str]) -> Option<String> {
        let sections: Vec<String> = sections.iter().map(|section| (*section).to_owned()).collect();
        let splices = config_txt(text, &sections, "x", wanted);
        let mut changed = text.to_owned();
        splices.iter().for_each(|(_, splice)| splice.apply(&mut changed));
        assert_eq!(config_txt(&changed, &sections, "x", wanted), [], "{changed}");
        for (_, splice) in splices.iter().rev() {
            splice.revert(&mut changed).unwrap();
        }
        assert_eq!(changed, text);
        let new: String = splices.into_iter().map(|(_, splice)| splice.new).collect();
        (!new.is_empty()).then_some(new)
    }

    #[test]
    fn a_line_that_is_on_is_not_written_again() {
        for text in [
            "dtparam=spi=on",
            "dtparam=spi\n",
            " dtparam=i2c_arm=on,spi=on\r\n",
            "dtparam=spi=off\ndtparam=spi=1\n",
            "[none]\ndtparam=x\n[all]\ndtparam=spi=true\n",
            "[pi4]\ndtparam=spi=on\n",
        ] {
            assert_eq!(with(text, &["pi4"], SPI), None, "{text:?}");
        }
        for text in [
            "",
            "#dtparam=spi=on\n",
            "dtparam=spi=off\n",
            "dtparam=spi=on\ndtparam=spi=off\n",
            "[pi5]\ndtparam=spi=on\n",
            "[cm4]\ndtparam=spi=on\n[HDMI:0]\n",
            "dtparam=spi2=on\n",
        ] {
            assert_eq!(with(text, &["pi4"], SPI).unwrap(), "# pinion add x\n[all]\ndtparam=spi=on\n", "{text:?}");
        }
        assert_eq!(with("a=b", &[], SPI).unwrap(), "\n# pinion add x\n[all]\ndtparam=spi=on\n");
        assert_eq!(with("a=b\r\n", &[], SPI).unwrap(), "# pinion add x\r\n[all]\r\ndtparam=spi=on\r\n");
        let two = &["dtparam=spi=on", "core_freq=250"];
        assert_eq!(with("core_freq=250\ncore_freq=400\ndtparam=spi=on", &[], two).unwrap().matches('=').count(), 1);
        assert_eq!(with("dtoverlay=w1-gpio,gpiopin=5\n", &[], &["dtoverlay=w1-gpio"]), None);
        for (text, line) in [
            ("dtoverlay=w1-gpio\n", None),
            ("dtoverlay=w1-gpio,pullup=1,gpiopin=27\n", Some(27)),
            ("dtoverlay=w1-gpio,gpiopin=27\n[none]\ndtoverlay=w1-gpio,gpiopin=5\n", Some(27)),
            ("#dtoverlay=w1-gpio,gpiopin=27\n", None),
            ("dtoverlay=w1-gpio,gpiopin=x\n", None),
        ] {
            assert_eq!(w1_line(text, &[]), line, "{text:?}");
        }
        let adc = &["dtoverlay=anyspi:spi0-0,dev=\"microchip,mcp3208\""];
        assert!(with("dtoverlay=anyspi:spi0-1,dev=\"a,b\"\n", &[], adc).is_some());
        assert_eq!(
            with(
                "dtparam=i2c1=on,i2c1_baudrate=400000",
                &[],
                &["dtparam=i2c_arm=on", "dtparam=i2c_arm_baudrate=400000"]
            ),
            None
        );
    }

    fn cb1(text: &str, files: &[&str]) -> Result<String, String> {
        let catalog = Catalog::read().unwrap();
        let tree = Tree::new();
        tree.put("proc/device-tree/model", "BigTreeTech CB1\0");
        let bus = &catalog.board(&tree.computer()).unwrap().bus[&Kind::Spi];
        let files: BTreeSet<String> = files.iter().map(|file| (*file).to_owned()).collect();
        let splices = overlays(text, bus, &files)?;
        let mut changed = text.to_owned();
        splices.iter().for_each(|splice| splice.apply(&mut changed));
        let result = changed.clone();
        assert_eq!(overlays(&changed, bus, &files), Ok(vec![]), "{changed}");
        for splice in splices.iter().rev() {
            splice.revert(&mut changed).unwrap();
        }
        assert_eq!(changed, text);
        Ok(result)
    }

    #[test]
    fn an_overlay_joins_the_others_in_the_line_that_counts() {
        let new = &["sun50i-h616-spidev1_1", "sun50i-h616-spi-spidev"];
        let head = "bootlogo=true\noverlay_prefix=sun50i-h616\n";
        let after = |rest: &str| cb1(&format!("{head}{rest}"), new).map(|text| text[head.len()..].to_owned());
        assert_eq!(
            after("overlays=ws2812 light\nrootdev=UUID=1\n").unwrap(),
            "overlays=ws2812 light spidev1_1\nrootdev=UUID=1\n"
        );
        assert_eq!(after("overlays=a\noverlays=b\n").unwrap(), "overlays=a\noverlays=b spidev1_1\n");
        assert_eq!(after("#overlays=a\n").unwrap(), "#overlays=a\noverlays=spidev1_1\n");
        assert_eq!(after("rootdev=1").unwrap(), "rootdev=1\noverlays=spidev1_1\n");
        assert_eq!(after("overlays=\r\nx=y\r\n").unwrap(), "overlays=spidev1_1\r\nx=y\r\n");
        assert_eq!(after("overlays= ").unwrap(), "overlays=spidev1_1 ");
        for on in ["overlays=x spidev1_1\n", "overlays=sun50i-h616-spidev1_1\n"] {
            assert_eq!(after(on).unwrap(), on);
        }
        let error = after("overlays=mcp2515\n").unwrap_err();
        assert_eq!(error, "the overlay mcp2515 uses spidev1.1 already: remove it from overlays=");
    }

    #[test]
    fn an_older_image_has_another_overlay_with_parameters() {
        let old = &["sun50i-h616-spi-spidev"];
        let text = cb1("overlay_prefix=sun50i-h616\nparam_spidev_spi_bus=0\n", old).unwrap();
        assert_eq!(
            text,
            "overlay_prefix=sun50i-h616\nparam_spidev_spi_bus=1\noverlays=spi-spidev\nparam_spidev_spi_cs=1\n"
        );
        // The name may have the prefix already, or none (armbian-mkspi#49).
        assert!(cb1("overlay_prefix=rockchip\n", &["spi-spidev"]).unwrap().contains("overlays=spi-spidev\n"));
        let error = cb1("overlay_prefix=rockchip\n", &["rockchip-rk3328-spi-spidev", "i2c0"]).unwrap_err();
        assert!(error.contains("which has rockchip-rk3328-spi-spidev: write"), "{error}");
        assert!(cb1("", &[]).unwrap_err().contains("no overlay for spidev1.1"));
    }

    proptest! {
        /// Whatever the file holds, a second time changes nothing, and the way back ends at the same bytes.
        #[test]
        fn settings_are_found_again_and_taken_back(
            text in "(dtparam=(spi|i2c)(=on|=off)?|\\[(all|pi4|none)\\]|#|overlays=[a-z ]{0,5}|param_spidev_spi_cs=[01]|\\PC{0,9}|\r?\n|\n){0,12}"
        ) {
            with(&text, &["pi4"], &["dtparam=spi=on", "dtparam=i2c_arm=on", "core_freq=250"]);
            for file in ["spidev1_1", "spi-spidev"] {
                let _ = cb1(&text, &[file]);
            }
        }
    }
}
