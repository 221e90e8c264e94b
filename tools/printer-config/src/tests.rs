// SPDX-License-Identifier: GPL-3.0-or-later
//! Configurations as klippy reads them, and the hostile ones that it would not survive.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use crate::copy::{Change, write};
use crate::files::{Disk, Files, normal};
use crate::pins::{Aliases, Pin};
use crate::{Config, Limit};

/// Files in memory.
struct Memory(BTreeMap<PathBuf, String>);

impl Files for Memory {
    fn text(&self, path: &Path) -> io::Result<String> {
        self.0.get(path).cloned().ok_or(io::ErrorKind::NotFound.into())
    }
    fn names(&self, folder: &Path, most: usize) -> Vec<String> {
        let paths = self.0.keys();
        let inside = paths.filter(|path| path.parent() == Some(folder));
        inside.filter_map(|path| path.file_name()?.to_str().map(str::to_owned)).take(most).collect()
    }

    fn is_there(&self, path: &Path) -> bool {
        self.0.contains_key(path)
    }

    fn whole(&self, path: &Path) -> PathBuf {
        normal(path)
    }
}

fn read_all(files: &[(&str, &str)]) -> Result<Config, String> {
    let memory = Memory(files.iter().map(|(path, text)| (PathBuf::from(path), (*text).to_owned())).collect());
    Config::read_from(&memory, Path::new(files[0].0)).map_err(|trouble| trouble.to_string())
}

fn read(text: &str) -> Config {
    read_all(&[("p.cfg", text)]).unwrap()
}

fn refusal(text: &str) -> String {
    read_all(&[("p.cfg", text)]).map(|_| ()).unwrap_err()
}

#[test]
fn comments_delimiters_and_long_values_are_klippys() {
    let config = read(concat!(
        "# a comment\n[stepper_x] # another\nStep_Pin = PA0 # a pin\ndir_pin:!PA1 ; reversed\nname: a;b\n",
        "[gcode_macro A]\ngcode:\n  G28 ; home\n\n  {% if x == 1 %}\n    G1 X1\n  ; a comment\n  {% endif %}\n\n\n[stepper_x]\nstep_pin: PB7\n",
    ));
    let x = config.section("stepper_x").unwrap();
    assert_eq!(x.text("step_pin"), Some("PB7"), "the later value");
    assert_eq!(x.setting("step_pin").unwrap().place.to_string(), "p.cfg:17");
    assert_eq!(x.text("dir_pin"), Some("!PA1"));
    assert_eq!(x.text("name"), Some("a;b"), "no white space before the semicolon");
    let gcode = config.section("gcode_macro A").unwrap().text("gcode");
    assert_eq!(gcode, Some("\nG28\n\n{% if x == 1 %}\nG1 X1\n{% endif %}"));
    assert_eq!(config.sections().len(), 2);
}

#[test]
fn what_klippy_refuses_is_refused_with_its_line() {
    for (text, line) in [
        ("a: 1\n", "p.cfg:1: File contains no section headers."),
        ("[a]\nno value\n", "p.cfg:2: Source contains parsing errors: 'no value'"),
        ("[a]\n\n: 1\n", "p.cfg:3: Source contains parsing errors: ': 1'"),
        ("[include other.cfg]\n", "p.cfg:1: Include file 'other.cfg' does not exist"),
    ] {
        assert!(refusal(text).starts_with(line), "{}", refusal(text));
    }
    let circle = read_all(&[("p.cfg", "[include a.cfg]\n"), ("a.cfg", "\n[include p.cfg]\n")]).unwrap_err();
    assert_eq!(circle, "p.cfg:1: a.cfg:2: Recursive include of config file 'p.cfg': remove the line");
}

#[test]
fn values_are_read_as_klippy_reads_them_and_refused_in_its_words() {
    let config = read("[a b c]\nf: 1_0.5\nbad: x\ni: 16\ny: Yes\nl: a, b ,c\nn: 1, 2.5\nr:\n  1,2\n  3,4\nzero: 0\n");
    let section = config.section("a b c").unwrap();
    assert_eq!((section.kind(), section.own_name()), ("a", Some("c")));
    assert_eq!(section.number("f", Limit::Any).unwrap(), Some(10.5));
    assert_eq!(section.number("none", Limit::Any).unwrap(), None);
    assert_eq!(section.whole("i", 1).unwrap(), Some(16));
    assert_eq!(section.truth("y").unwrap(), Some(true));
    assert_eq!(section.list("l", ','), ["a", "b", "c"]);
    assert_eq!(section.numbers("n").unwrap(), Some(vec![1.0, 2.5]));
    assert_eq!(section.rows("r").unwrap(), Some(vec![vec![1.0, 2.0], vec![3.0, 4.0]]));
    let refused = |error: crate::Trouble| error.found();
    let word = |key| format!("Unable to parse option '{key}' in section 'a b c'");
    assert_eq!(refused(section.number("bad", Limit::Any).unwrap_err()), format!("p.cfg:3: {}", word("bad")));
    assert_eq!(refused(section.whole("f", 1).unwrap_err()), format!("p.cfg:2: {}", word("f")));
    assert_eq!(
        refused(section.number("zero", Limit::Above(0.0)).unwrap_err()),
        "p.cfg:11: Option 'zero' in section 'a b c' must be above 0.0"
    );
    assert_eq!(
        refused(section.required("pin").unwrap_err()),
        "p.cfg:1: Option 'pin' in section 'a b c' must be specified"
    );
}

const SAVED: &str = "\n#*# <---------------------- SAVE_CONFIG ---------------------->\n#*# DO NOT EDIT THIS BLOCK OR BELOW. The contents are auto-generated.\n#*#\n";

#[test]
fn the_saved_block_sets_what_the_files_do_not_set() {
    let block =
        "#*# [probe]\n#*# z_offset = 1.5\n#*# speed = 2\n#*# [bed_mesh m]\n#*# points =\n#*# \t1, 2\n#*# \t3, 4\n";
    let config = read(&format!("[probe]\npin: PA0\nspeed: 5\n{SAVED}{block}"));
    let probe = config.section("probe").unwrap();
    assert_eq!((probe.text("z_offset"), probe.text("speed")), (Some("1.5"), Some("5")));
    assert_eq!(probe.setting("z_offset").unwrap().place.to_string(), "p.cfg:9");
    let points = config.section("bed_mesh m").unwrap().rows("points").unwrap();
    assert_eq!(points, Some(vec![vec![1.0, 2.0], vec![3.0, 4.0]]));
    let edited = read(&format!("[probe]\npin: PA0\n{SAVED}#*# [probe]\nz_offset = 1.5\n"));
    assert_eq!(edited.section("probe").unwrap().text("z_offset"), Some("1.5"), "the block is no block any more");
}

#[test]
fn includes_find_files_as_pythons_glob_does() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    fs::create_dir_all(path("macros/deep")).unwrap();
    for (name, text) in [
        ("printer.cfg", "[a]\nx: 1\n[include macros/*.cfg]\n[a]\nz: 3\n[include none*.cfg]\n"),
        ("macros/2.cfg", "[a]\nx: 2\n"),
        ("macros/1.cfg", "[a]\nx: 9\ny: 1\n[include deep/d?ep.cfg]\n"),
        ("macros/.hidden.cfg", "[hidden]\n"),
        ("macros/deep/deep.cfg", "[deep]\n"),
    ] {
        fs::write(path(name), text).unwrap();
    }
    let config = Config::read(&path("printer.cfg")).unwrap();
    let a = config.section("a").unwrap();
    assert_eq!([a.text("x"), a.text("y"), a.text("z")], [Some("2"), Some("1"), Some("3")]);
    assert!(config.section("hidden").is_none() && config.section("deep").is_some());
    assert_eq!(config.paths().count(), 4);
    std::os::unix::fs::symlink("nowhere", path("link.cfg")).unwrap();
    let text = "[a]\nx: 1\n[include link.cfg]\n[include macros/1.cfg]\n[include no.cfg]\n[b]\n";
    fs::write(path("printer.cfg"), text).unwrap();
    let (config, missing) =
        Config::read_present(&path("printer.cfg"), |file| if file.ends_with("no.cfg") { "[of_no]\n" } else { "" })
            .unwrap();
    assert_eq!((config.section("a").unwrap().text("x"), config.section("b").is_some()), (Some("9"), true));
    let missing: Vec<String> = missing.iter().map(ToString::to_string).collect();
    assert!(missing[0].contains("printer.cfg:3: ") && missing[1].contains("printer.cfg:5: "), "{missing:?}");
    assert_eq!(missing.len(), 2);
    let copied = write(&config, &[], &path("copy")).unwrap();
    let copied = fs::read_to_string(copied).unwrap();
    assert_eq!((copied.as_str(), config.section("of_no").is_some()), (text, true));
    assert_eq!(fs::read_to_string(path("copy/no.cfg")).unwrap(), "[of_no]\n");
    assert_eq!(fs::read_to_string(path("copy/link.cfg")).unwrap(), "");
    for (name, line) in [("link.cfg", "link.cfg: Unable to open config file: "), ("no.cfg", "no.cfg' does not exist: ")]
    {
        fs::write(path("printer.cfg"), format!("[a]\n[include {name}]\n")).unwrap();
        let refusal = Config::read(&path("printer.cfg")).unwrap_err().to_string();
        assert!(refusal.contains("printer.cfg:2: ") && refusal.contains(line), "{refusal}");
    }
}

#[test]
fn hostile_configurations_end_at_once_with_a_line() {
    let refused = |text: &str, part: &str| assert!(refusal(text).contains(part), "{}", refusal(text));
    let sections: String = (0..10_000).map(|n| format!("[s{n}]\n")).collect();
    refused(&sections, "p.cfg:5001: there are more than 5000 sections");
    let options: String = (0..60_000).map(|n| format!("k{}: 1\n", n % 100)).collect();
    refused(&format!("[s]\n{options}"), "there are more than 50000 options");
    refused(&"[include none*.cfg]\n".repeat(2000), "p.cfg:1001: there are more than 1000 includes");
    // The name of a section is kept once, not once for each option.
    let (name, options) = ("s".repeat(1 << 20), (0..40_000).map(|n| format!("k{n}: 1\n")).collect::<String>());
    assert_eq!(read(&format!("[{name}]\n{options}")).sections()[0].settings().len(), 40_000);
    // Each file includes the next one twice.
    let names: Vec<String> = (0..30).map(|n| format!("{n}.cfg")).collect();
    let texts: Vec<String> = (1..31).map(|n| format!("[include {n}.cfg]\n[include {n}.cfg]\n")).collect();
    let mut files: Vec<(&str, &str)> = names.iter().zip(&texts).map(|(name, text)| (&**name, &**text)).collect();
    files.push(("30.cfg", ""));
    assert!(read_all(&files).unwrap_err().contains("more than 500 files are included"));

    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("p.cfg");
    let read = || Config::read(&path).map(|_| ()).unwrap_err().to_string();
    nix::unistd::mkfifo(&path, nix::sys::stat::Mode::S_IRWXU).unwrap();
    assert!(read().contains("it is not a regular file"), "{}", read());
    fs::remove_file(&path).unwrap();
    fs::File::create(&path).unwrap().set_len(1 << 30).unwrap();
    assert!(read().contains("it is longer than 4 MiB"), "{}", read());
    fs::write(&path, [0xff, 0xfe]).unwrap();
    assert!(read().contains("it is not UTF-8 text"), "{}", read());
    assert!(Disk.text(Path::new("/dev/zero")).is_err());
}

#[test]
fn pins_have_a_chip_and_marks() {
    let pin = |text| Pin::parse(text, true, true);
    let parsed = pin(" ^!z: P1.20 ").unwrap();
    assert_eq!((&*parsed.chip, &*parsed.name, parsed.inverted, parsed.pull), ("z", "P1.20", true, 1));
    assert_eq!((pin("~PA0").unwrap().pull, pin("PA0").unwrap().chip), (-1, "mcu".to_owned()));
    assert_eq!(parsed.to_string(), "!z:P1.20");
    assert!(pin("!^PA0").unwrap_err().starts_with("Invalid pin description '!^PA0'"));
    assert!(Pin::parse("!PA0", false, false).unwrap_err().ends_with("Format is: [chip_name:] pin_name"));

    let config = read("[board_pins a]\nmcu: z\naliases:\n  E=PA1,\n  F=E\naliases_more: G=<NC>\n");
    let aliases = Aliases::read(&config).unwrap();
    let resolved = |text| aliases.resolve(&Pin::parse(text, true, true).unwrap()).to_string();
    assert_eq!([resolved("!z:F"), resolved("F"), resolved("z:PA9")], ["!z:PA1", "F", "z:PA9"]);
    assert_eq!(aliases.reserved(&Pin::parse("z:G", true, true).unwrap()), Some("<NC>"));
    let twice = read("[board_pins]\naliases: A=PA1, A=PA2\n");
    let error = Aliases::read(&twice).unwrap_err().to_string();
    assert!(error.starts_with("p.cfg:2: Alias A mapped to PA1 - can't alias to PA2"), "{error}");
}

#[test]
fn constants_of_kalico_are_put_in() {
    let mut config = read("[constants]\nd: 8\n[a]\nx: ${constants.d}\ny: ${x}0\nz: ${none.d}\nr: ${r}\n");
    config.put_constants_in();
    let a = config.section("a").unwrap();
    assert_eq!([a.text("x"), a.text("y"), a.text("z")], [Some("8"), Some("80"), Some("${none.d}")]);
    assert_eq!(a.text("r"), Some("${r}"));
}

#[test]
fn a_copy_differs_only_where_asked_and_stays_in_its_folder() {
    let root = tempfile::tempdir().unwrap();
    let home = root.path().join("home");
    fs::create_dir_all(home.join("sub")).unwrap();
    let main = "[include ../shared.cfg]\n[include sub/*.cfg]\n[mcu]  # main\nserial: /dev/a\n  b\nbaud: 1\nother: 5\n[mcu]\nserial: /dev/c\n";
    fs::write(home.join("printer.cfg"), main).unwrap();
    fs::write(root.path().join("shared.cfg"), "[shared]\nx: 1\n").unwrap();
    fs::write(home.join("sub/z.cfg"), "[mcu z]\ncanbus_uuid: 1\n").unwrap();
    let config = Config::read(&home.join("printer.cfg")).unwrap();
    let change = |section: &str, serial: &str| Change {
        section: section.into(),
        left_out: false,
        instead: None,
        without: ["serial", "baud", "canbus_uuid"].map(Into::into).into(),
        with: vec![("serial".into(), serial.into())],
    };
    let folder = root.path().join("copy");
    let copied = write(&config, &[change("mcu", "/tmp/m"), change("mcu z", "/tmp/z")], &folder).unwrap();
    assert_eq!(
        fs::read_to_string(&copied).unwrap(),
        "[include outside/1/shared.cfg]\n[include sub/*.cfg]\n[mcu]  # main\nserial: /tmp/m\n# serial: /dev/a\n#   b\n# baud: 1\nother: 5\n[mcu]\n# serial: /dev/c\n"
    );
    let again = Config::read(&copied).unwrap();
    assert_eq!(again.section("mcu").unwrap().text("serial"), Some("/tmp/m"));
    assert_eq!(again.section("mcu z").unwrap().text("serial"), Some("/tmp/z"));
    assert_eq!(again.section("shared").unwrap().text("x"), Some("1"));
    assert_eq!(fs::read_to_string(home.join("printer.cfg")).unwrap(), main, "the original");
}

#[test]
fn a_copy_without_a_section_has_none_of_its_lines() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("printer.cfg");
    let saved = "#*# <---------------------- SAVE_CONFIG ---------------------->\n#*# DO NOT EDIT THIS BLOCK OR BELOW. The contents are auto-generated.\n#*#\n#*# [a]\n#*# z =\n#*# \t1, 2\n#*#\n#*# [b]\n#*# z_offset = 1.5\n";
    fs::write(&path, format!("[a]\nx: 1\n  2\n[b]  # b\n[a]\n# y\ny: 3\n{saved}")).unwrap();
    let config = Config::read(&path).unwrap();
    let gone = Change { section: "a".into(), left_out: true, ..Change::default() };
    let copied = write(&config, &[gone], &folder.path().join("copy")).unwrap();
    let text = fs::read_to_string(&copied).unwrap();
    let saved = "#*# <---------------------- SAVE_CONFIG ---------------------->\n#*# DO NOT EDIT THIS BLOCK OR BELOW. The contents are auto-generated.\n#*#\n#*# # [a]\n#*# # z =\n#*# # \t1, 2\n#*#\n#*# [b]\n#*# z_offset = 1.5\n";
    assert_eq!(text, format!("# [a]\n# x: 1\n#   2\n[b]  # b\n# [a]\n# y\n# y: 3\n{saved}"));
    let again = Config::read(&copied).unwrap();
    assert!(again.section("a").is_none());
    assert_eq!(again.section("b").unwrap().text("z_offset"), Some("1.5"), "the block counts");
    // A section that only the block has.
    fs::write(&path, format!("#*# old\n[c]\n\n{}", saved.replace("# # ", "# "))).unwrap();
    let config = Config::read(&path).unwrap();
    let another =
        Change { instead: Some("[d]\nx: 1".into()), section: "a".into(), left_out: true, ..Change::default() };
    let copied = write(&config, &[another], &folder.path().join("other")).unwrap();
    let again = Config::read(&copied).unwrap();
    assert_eq!(again.section("d").unwrap().text("x"), Some("1"));
    assert_eq!(again.section("b").unwrap().text("z_offset"), Some("1.5"), "the block counts");
    assert!(again.section("a").is_none());
}

/// Each of them finds nothing, and has to look at all names.
#[test]
fn many_patterns_do_not_keep_a_reader_busy() {
    let names: Vec<String> = (0..200).map(|n| format!("d/{n}.cfg")).collect();
    let text = "[include x*.cfg]\n".repeat(990);
    let mut files: Vec<(&str, &str)> = vec![("d/p.cfg", &text)];
    files.extend(names.iter().map(|name| (name.as_str(), "")));
    let error = read_all(&files).map(drop).unwrap_err();
    assert!(error.contains("the patterns look at more than 100000 names"), "{error}");
}
