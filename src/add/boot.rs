// SPDX-License-Identifier: GPL-3.0-or-later
//! The lines that enable a bus in the boot loader's settings, and the way back.
//!
//! Each of our lines has a comment with the device that needs it. So the file itself says which lines are ours:
//!
//! ```text
//! # pinion add adxl345
//! [all]
//! dtparam=spi=on
//! ```
//!
//! In a file with `overlays=` the comment also names the change: `# pinion add adxl345: overlays+=spidev1_1`.

use std::collections::BTreeSet;

use super::edit::MARK;
use pinion_system::board::Bus;
use pinion_system::uses::boot::{ConfigTxt, Env};

fn end_of(text: &str) -> &'static str {
    if text.contains("\r\n") { "\r\n" } else { "\n" }
}

/// A text whose last line has an end.
fn ended(text: &str) -> String {
    if text.is_empty() || text.ends_with('\n') { text.to_owned() } else { format!("{text}{}", end_of(text)) }
}

/// A text of config.txt with these lines, which `device` needs.
pub(super) fn config_txt(text: &str, config: &ConfigTxt, device: &str, wanted: &[String]) -> String {
    let end = end_of(text);
    let missing = wanted.iter().filter(|line| !config.has(line));
    missing.fold(text.to_owned(), |text, line| ended(&text) + &format!("# {MARK} {device}{end}[all]{end}{line}{end}"))
}

/// One of our lines in a config.txt.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Own {
    /// The number of the comment above it, from 0.
    at: usize,
    pub(super) device: String,
    pub(super) line: String,
}

/// Our lines in a config.txt. One that somebody has changed is theirs.
pub(super) fn own_lines(text: &str) -> Vec<Own> {
    let lines: Vec<&str> = text.lines().map(str::trim_end).collect();
    let own = lines.windows(3).enumerate().filter_map(|(at, three)| {
        let device = three[0].strip_prefix("# ")?.strip_prefix(MARK)?.trim();
        let is_line = three[1] == "[all]" && !three[2].contains(['#', '[']) && three[2].contains('=');
        is_line.then(|| Own { at, device: device.to_owned(), line: three[2].to_owned() })
    });
    own.collect()
}

/// Whether a config.txt still has lines of a device that somebody has changed.
pub(super) fn has_changed_lines(text: &str, device: &str) -> bool {
    let mark = format!("# {MARK} {device}");
    let own = own_lines(text);
    text.lines().filter(|line| line.trim_end() == mark).count() > own.iter().filter(|own| own.device == device).count()
}

/// The text without one of our lines.
pub(super) fn without(text: &str, own: &Own) -> String {
    let lines: Vec<&str> = text.split_inclusive('\n').collect();
    let section = |lines: &[&str]| {
        lines.iter().rev().map(|line| line.trim()).find(|line| line.starts_with('[')).map(str::to_owned)
    };
    // Lines behind ours may rely on our section.
    let before = section(&lines[..own.at]).is_none_or(|section| section == "[all]");
    let next =
        lines[own.at + 3..].iter().map(|line| line.trim()).find(|line| !line.is_empty() && !line.starts_with('#'));
    let keeps = !before && next.is_some_and(|next| !next.starts_with('['));
    let is_gone = |at: usize| (own.at..own.at + 3).contains(&at) && !(keeps && at == own.at + 1);
    lines.iter().enumerate().filter(|(at, _)| !is_gone(*at)).map(|(_, line)| *line).collect()
}

/// The text in which one of our lines is another device's.
pub(super) fn handed_over(text: &str, own: &Own, device: &str) -> String {
    let end = end_of(text);
    let line =
        |(at, line): (usize, &str)| if at == own.at { format!("# {MARK} {device}{end}") } else { line.to_owned() };
    text.split_inclusive('\n').enumerate().map(line).collect()
}

/// An armbianEnv.txt or its like in which an overlay of this bus is loaded. `files` are the names of the image's overlays,
/// without `.dtbo`.
///
/// # Errors
///
/// One line: the image has none of the known overlays.
pub(super) fn overlays(text: &str, bus: &Bus, files: &BTreeSet<String>, device: &str) -> Result<String, String> {
    let env = Env::of(text);
    let loaded = || env.value("overlays").unwrap_or_default().split_whitespace();
    if bus.overlays.iter().any(|way| loaded().any(|name| env.is(name, way))) {
        return Ok(text.to_owned());
    }
    let has = |way: &&Vec<String>| way.first().is_some_and(|name| files.iter().any(|file| env.short(file) == name));
    let Some((name, parameters)) = bus.overlays.iter().find(has).and_then(|way| way.split_first()) else {
        let kind = bus.node.trim_end_matches(|c: char| !c.is_alphabetic()).trim_end_matches("dev");
        let near: Vec<&str> = files.iter().map(String::as_str).filter(|file| file.contains(kind)).take(8).collect();
        return Err(match near[..] {
            [] => format!("this image has no overlay for {}: look for one in the image's documentation", bus.node),
            _ => format!(
                "none of the known overlays for {} is in this image, which has {}: write the right one into overlays=",
                bus.node,
                near.join(", ")
            ),
        });
    };
    let end = end_of(text);
    let mut changed = text.to_owned();
    if !loaded().any(|own| env.short(own) == name) {
        let words = env.value("overlays").filter(|words| !words.is_empty());
        let words = words.map_or_else(|| name.clone(), |words| format!("{words} {name}"));
        changed = set(&changed, "overlays", &words);
        changed = ended(&changed) + &format!("# {MARK} {device}: overlays+={name}{end}");
    }
    for line in parameters {
        let (key, value) = line.split_once('=').unwrap_or((line, ""));
        let old = Env::of(&changed).value(key).map(str::to_owned);
        if old.as_deref() == Some(value) {
            continue;
        }
        changed = set(&changed, key, value);
        let was = old.map_or("not set".to_owned(), |old| format!("was {old}"));
        changed = ended(&changed) + &format!("# {MARK} {device}: {line}, {was}{end}");
    }
    Ok(changed)
}

/// The changes of an `overlays=` file that are a device's, without the comments' beginnings.
pub(super) fn own_settings(text: &str, device: &str) -> Vec<String> {
    let head = format!("# {MARK} {device}: ");
    text.lines().filter_map(|line| line.trim_end().strip_prefix(&head)).map(str::to_owned).collect()
}

/// The text without these changes of a device, and a line for each that is not as it was written.
pub(super) fn without_settings(text: &str, device: &str, left: &mut Vec<String>) -> String {
    let mut text = text.to_owned();
    for own in own_settings(&text, device).into_iter().rev() {
        let mark = format!("# {MARK} {device}: {own}");
        text = text.split_inclusive('\n').filter(|line| line.trim_end() != mark).collect();
        if let Some(word) = own.strip_prefix("overlays+=") {
            let value = Env::of(&text).value("overlays").unwrap_or_default();
            let words: Vec<&str> = value.split_whitespace().collect();
            if !words.contains(&word) {
                left.push(format!("overlays= no longer has {word}"));
                continue;
            }
            // The user's own spaces stay.
            let rest = value.strip_suffix(&format!(" {word}")).map(str::to_owned);
            let others = || words.iter().copied().filter(|own| *own != word).collect::<Vec<_>>().join(" ");
            let rest = rest.unwrap_or_else(others);
            text = if rest.is_empty() { unset(&text, "overlays") } else { set(&text, "overlays", &rest) };
            continue;
        }
        let Some(((key, value), was)) = own.rsplit_once(", ").and_then(|(set, was)| Some((set.split_once('=')?, was)))
        else {
            continue;
        };
        if Env::of(&text).value(key) != Some(value) {
            left.push(format!("{key} is no longer {value}, so it stays as it is"));
            continue;
        }
        text = was.strip_prefix("was ").map_or_else(|| unset(&text, key), |old| set(&text, key, old));
    }
    text
}

/// The text in which a device's changes are another device's.
pub(super) fn settings_handed_over(text: &str, device: &str, to: &str) -> String {
    text.replace(&format!("# {MARK} {device}: "), &format!("# {MARK} {to}: "))
}

/// The text with a key's last line changed by `change`.
fn changed(text: &str, key: &str, change: impl Fn(&str) -> String) -> Option<String> {
    let is_it = |line: &&str| line.strip_prefix(key).is_some_and(|rest| rest.starts_with('='));
    let at = text.split_inclusive('\n').collect::<Vec<_>>().iter().rposition(is_it)?;
    let line = |(number, line): (usize, &str)| if number == at { change(line) } else { line.to_owned() };
    Some(text.split_inclusive('\n').enumerate().map(line).collect())
}

/// Sets a key to a value. The spaces around the old value stay.
fn set(text: &str, key: &str, value: &str) -> String {
    let with = |line: &str| {
        let (head, old) = line.split_at(key.len() + 1);
        let end = &old[old.trim_end().len()..];
        let begin = &old[..old.len() - end.len() - old.trim().len()];
        format!("{head}{begin}{value}{end}")
    };
    changed(text, key, with).unwrap_or_else(|| ended(text) + &format!("{key}={value}{}", end_of(text)))
}

fn unset(text: &str, key: &str) -> String {
    changed(text, key, |_| String::new()).unwrap_or_else(|| text.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tree::Tree;
    use pinion_system::board::{Board, Kind};
    use proptest::prelude::*;

    const FILE: &str = "/boot/firmware/config.txt";

    /// A config.txt of a Raspberry Pi 4 with these lines on, and the way back. `None` if nothing was missing.
    fn with(text: &str, wanted: &[&str]) -> Option<String> {
        let tree = Tree::empty();
        tree.put("proc/device-tree/model", "Raspberry Pi 4 Model B Rev 1.4\0");
        let wanted: Vec<String> = wanted.iter().map(|line| (*line).to_owned()).collect();
        let on = |text: &str| {
            tree.put(FILE.trim_start_matches('/'), text);
            let computer = tree.computer();
            let board = Board::of(&computer, None).unwrap().unwrap();
            config_txt(text, &ConfigTxt::read(&computer, Some(&board)), "x", &wanted)
        };
        let changed = on(text);
        assert_eq!(on(&changed), changed, "a second time");
        let mut back = changed.clone();
        for own in own_lines(&changed).iter().rev().filter(|own| own.device == "x") {
            back = without(&back, own);
        }
        assert_eq!(back.trim_end_matches(['\r', '\n']), text.trim_end_matches(['\r', '\n']), "{changed:?}");
        (changed != text).then(|| changed[text.len()..].to_owned())
    }

    #[test]
    fn a_line_that_is_on_is_not_written_again() {
        const SPI: &[&str] = &["dtparam=spi=on"];
        for text in [
            "dtparam=spi=on",
            "dtparam=spi\n",
            " dtparam=i2c_arm=on,spi=on\r\n",
            "dtparam=spi=off\ndtparam=spi=1\n",
            "[none]\ndtparam=x\n[all]\ndtparam=spi=true\n",
            "[pi4]\ndtparam=spi=on\n",
            "dtoverlay=w1-gpio\ndtparam=spi=on\n",
        ] {
            assert_eq!(with(text, SPI), None, "{text:?}");
        }
        for text in [
            "",
            "#dtparam=spi=on\n",
            "dtparam=spi=off\n",
            "dtparam=spi=on\ndtparam=spi=off\n",
            "[pi5]\ndtparam=spi=on\n",
            "[cm4]\ndtparam=spi=on\n[HDMI:0]\n",
            "[EDID=x]\ndtparam=spi=on\n",
            "[none]\n[pi4]\ndtparam=spi=on\n",
            "dtparam=spi2=on\n",
        ] {
            assert_eq!(with(text, SPI).unwrap(), "# pinion add x\n[all]\ndtparam=spi=on\n", "{text:?}");
        }
        assert_eq!(with("a=b", SPI).unwrap(), "\n# pinion add x\n[all]\ndtparam=spi=on\n");
        assert_eq!(with("a=b\r\n", SPI).unwrap(), "# pinion add x\r\n[all]\r\ndtparam=spi=on\r\n");
        let two = &["dtparam=spi=on", "core_freq=250"];
        assert_eq!(with("core_freq=250\ncore_freq=400\ndtparam=spi=on", two).unwrap().matches('=').count(), 1);
        assert_eq!(with("dtoverlay=w1-gpio,gpiopin=5\n", &["dtoverlay=w1-gpio"]), None);
        let adc = &["dtoverlay=anyspi:spi0-0,dev=\"microchip,mcp3208\""];
        assert!(with("dtoverlay=anyspi:spi0-1,dev=\"microchip,mcp3208\"\n", adc).is_some());
        assert_eq!(with(&format!("{},speed=9\n", adc[0]), adc), None);
        let clock = &["dtparam=i2c_arm=on", "dtparam=i2c_arm_baudrate=400000"];
        assert_eq!(with("dtparam=i2c1=on,i2c1_baudrate=400000", clock), None);
    }

    /// The user has written behind our line since, and relies on its section.
    #[test]
    fn lines_of_the_user_stay_in_the_section_that_they_had() {
        let own = "# pinion add x\n[all]\ndtparam=spi=on\n";
        let back = |text: &str| without(text, &own_lines(text)[0]);
        assert_eq!(back(&format!("[cm5]\na=b\n{own}c=d\n")), "[cm5]\na=b\n[all]\nc=d\n");
        assert_eq!(back(&format!("[cm5]\na=b\n{own}[pi4]\nc=d\n")), "[cm5]\na=b\n[pi4]\nc=d\n");
        assert_eq!(back(&format!("a=b\n{own}c=d\n")), "a=b\nc=d\n");
        // Somebody has changed it, and so it is theirs.
        for changed in
            ["# pinion add x\n[all]\n#dtparam=spi=on\n", "# pinion add x\n[pi4]\ndtparam=spi=on\n", "dtparam=spi=on\n"]
        {
            assert_eq!(own_lines(changed), [], "{changed}");
        }
        assert_eq!(handed_over(own, &own_lines(own)[0], "y"), own.replace('x', "y"));
    }

    fn cb1(text: &str, files: &[&str]) -> Result<String, String> {
        let tree = Tree::empty();
        tree.put("proc/device-tree/model", "BigTreeTech CB1\0");
        let board = Board::of(&tree.computer(), None).unwrap().unwrap();
        let files: BTreeSet<String> = files.iter().map(|file| (*file).to_owned()).collect();
        let bus = &board.bus[&Kind::Spi];
        let changed = overlays(text, bus, &files, "x")?;
        assert_eq!(overlays(&changed, bus, &files, "x").as_ref(), Ok(&changed), "a second time");
        let mut left = Vec::new();
        let back = without_settings(&changed, "x", &mut left);
        let empty = text.lines().filter(|line| !line.trim_end().ends_with("overlays=")).count() < text.lines().count();
        if !empty {
            assert_eq!(back.trim_end(), text.trim_end(), "{changed}");
        }
        assert!(left.is_empty(), "{left:?}");
        Ok(changed)
    }

    #[test]
    fn an_overlay_joins_the_others_in_the_line_that_counts() {
        let new = &["sun50i-h616-spidev1_1", "sun50i-h616-spi-spidev"];
        let head = "bootlogo=true\noverlay_prefix=sun50i-h616\n";
        let after = |rest: &str| cb1(&format!("{head}{rest}"), new).map(|text| text[head.len()..].to_owned());
        let mark = "# pinion add x: overlays+=spidev1_1\n";
        for (before, expected) in [
            ("overlays=ws2812 light\nrootdev=UUID=1\n", "overlays=ws2812 light spidev1_1\nrootdev=UUID=1\n"),
            ("overlays=a\noverlays=b\n", "overlays=a\noverlays=b spidev1_1\n"),
            ("#overlays=a\n", "#overlays=a\noverlays=spidev1_1\n"),
            ("rootdev=1", "rootdev=1\noverlays=spidev1_1\n"),
            ("overlays=\n", "overlays=spidev1_1\n"),
            ("overlays= a \t\nx=1\n", "overlays= a spidev1_1 \t\nx=1\n"),
        ] {
            assert_eq!(after(before).unwrap(), format!("{expected}{mark}"));
        }
        assert_eq!(after("overlays=a\r\n").unwrap(), "overlays=a spidev1_1\r\n# pinion add x: overlays+=spidev1_1\r\n");
        for on in ["overlays=x spidev1_1\n", "overlays=sun50i-h616-spidev1_1\n"] {
            assert_eq!(after(on).unwrap(), on);
        }
    }

    #[test]
    fn an_older_image_has_another_overlay_with_parameters() {
        let old = &["sun50i-h616-spi-spidev"];
        let text = cb1("overlay_prefix=sun50i-h616\nparam_spidev_spi_bus=0\n", old).unwrap();
        assert_eq!(
            text,
            "overlay_prefix=sun50i-h616\nparam_spidev_spi_bus=1\noverlays=spi-spidev\n\
             # pinion add x: overlays+=spi-spidev\n# pinion add x: param_spidev_spi_bus=1, was 0\n\
             param_spidev_spi_cs=1\n# pinion add x: param_spidev_spi_cs=1, not set\n"
        );
        // The name may have the prefix already, or none (armbian-mkspi#49).
        assert!(cb1("overlay_prefix=rockchip\n", &["spi-spidev"]).unwrap().contains("overlays=spi-spidev\n"));
        let error = cb1("overlay_prefix=rockchip\n", &["rockchip-rk3328-spi-spidev", "i2c0"]).unwrap_err();
        assert!(error.contains("which has rockchip-rk3328-spi-spidev: write"), "{error}");
        assert!(cb1("", &[]).unwrap_err().contains("no overlay for spidev1.1"));
        // A value that begins like ours is the user's.
        let mut left = Vec::new();
        let changed = text.replace("param_spidev_spi_bus=1\n", "param_spidev_spi_bus=10\n");
        let back = without_settings(&changed, "x", &mut left);
        assert_eq!(back, "overlay_prefix=sun50i-h616\nparam_spidev_spi_bus=10\n");
        assert_eq!(left, ["param_spidev_spi_bus is no longer 1, so it stays as it is"]);
    }

    proptest! {
        /// Whatever the file holds, a second time changes nothing, and the way back ends at the same lines.
        #[test]
        fn settings_are_found_again_and_taken_back(
            text in "(dtparam=(spi|i2c)(=on|=off)?|\\[(all|pi4|none)\\]|#|overlays=[a-z]{1,5}|param_spidev_spi_cs=[01]|\\PC{0,9}|\n){0,12}"
        ) {
            with(&text, &["dtparam=spi=on", "dtparam=i2c_arm=on", "core_freq=250"]);
            for file in ["spidev1_1", "spi-spidev"] {
                let _ = cb1(&text, &[file]);
            }
        }
    }
}
