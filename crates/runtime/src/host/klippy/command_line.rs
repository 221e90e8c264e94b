// SPDX-License-Identifier: GPL-3.0-or-later
//! klippy's command line: its folder, its configuration and its API server.

use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};

/// The place of klippy in its command line, and klippy's folder: the folder of `klippy.py`, or the one that `-m klippy`
/// names.
fn program(arguments: &[PathBuf]) -> Option<(usize, &Path)> {
    let is_script = |argument: &PathBuf| argument.file_name().is_some_and(|name| name == "klippy.py");
    let is_module = |pair: &[PathBuf]| {
        pair[0].as_os_str() == "-m" && (pair[1].as_os_str() == "klippy" || pair[1].as_os_str() == "klippy.klippy")
    };
    match arguments.iter().position(is_script) {
        Some(at) => Some((at, arguments[at].parent()?)),
        None => Some((arguments.windows(2).position(is_module)? + 1, Path::new("klippy"))),
    }
}

/// klippy's folder, if a command line is klippy's.
pub fn klippy(arguments: &[PathBuf]) -> Option<&Path> {
    program(arguments).map(|(_, folder)| folder)
}

/// The configuration that klippy's command line names.
pub fn klippy_config(arguments: &[PathBuf]) -> Option<&Path> {
    // These options of klippy/klippy.py, and of Kalico's klippy/printer.py, take a value.
    const WITH_VALUE: [&str; 15] = [
        "-i",
        "--debuginput",
        "-I",
        "--input-tty",
        "-a",
        "--api-server",
        "--api-server-user",
        "--api-server-group",
        "--api-server-file-mode",
        "-l",
        "--logfile",
        "-o",
        "--debugoutput",
        "-d",
        "--dictionary",
    ];
    let (at, _) = program(arguments)?;
    let mut words = arguments[at + 1..].iter();
    while let Some(word) = words.next() {
        if WITH_VALUE.iter().any(|option| word.as_os_str() == *option) {
            words.next();
        } else if !word.as_os_str().as_bytes().starts_with(b"-") {
            return Some(word);
        }
    }
    None
}

/// The socket of the API server that klippy's command line names.
pub fn klippy_api(arguments: &[PathBuf]) -> Option<&Path> {
    let (at, _) = program(arguments)?;
    let is_option = |word: &PathBuf| word.as_os_str() == "-a" || word.as_os_str() == "--api-server";
    arguments[at + 1..].windows(2).find(|pair| is_option(&pair[0])).map(|pair| pair[1].as_path())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn klippy_is_found_by_its_script_or_its_module() {
        let folder = |line: &str| {
            let arguments: Vec<PathBuf> = line.split(' ').map(PathBuf::from).collect();
            klippy(&arguments).map(Path::to_owned)
        };
        assert_eq!(folder("nice -n 5 python3 -u /a/klippy/klippy.py p.cfg"), Some("/a/klippy".into()));
        assert_eq!(folder("python3 klippy.py p.cfg"), Some("".into()));
        assert_eq!(folder("python3 -m klippy p.cfg"), Some("klippy".into()));
        assert_eq!(folder("python3 -m klippy.klippy p.cfg"), Some("klippy".into()));
        assert_eq!(folder("python3 -m http.server klippy"), None);
    }

    #[test]
    fn the_api_server_is_the_one_of_klippy_s_options() {
        let api = |line: &str| {
            let arguments: Vec<PathBuf> = line.split(' ').map(PathBuf::from).collect();
            klippy_api(&arguments).map(Path::to_owned)
        };
        let socket = Some("/c/klippy.sock".into());
        assert_eq!(api("python3 /a/klippy/klippy.py /b/p.cfg -I /c/tty -a /c/klippy.sock -l /c/log"), socket);
        assert_eq!(api("python3 -m klippy --api-server /c/klippy.sock /b/p.cfg"), socket);
        for none in ["python3 /a/klippy.py /b/p.cfg", "python3 /a/klippy.py /b/p.cfg -a", "socat -a /c/klippy.sock"] {
            assert_eq!(api(none), None, "{none}");
        }
    }

    #[test]
    fn the_configuration_is_what_is_no_option_of_klippy_s() {
        let config = |line: &str| {
            let arguments: Vec<PathBuf> = line.split(' ').map(PathBuf::from).collect();
            klippy_config(&arguments).map(Path::to_owned)
        };
        for line in [
            "python3 /a/klippy/klippy.py /b/p.cfg -I /c/klippy.serial -l /c/klippy.log -a /c/klippy.sock",
            "python3 /a/klippy/klippy.py -v -l /c/klippy.log --api-server=/c/klippy.sock /b/p.cfg",
            "python3 -m klippy --api-server-group klipper /b/p.cfg",
        ] {
            assert_eq!(config(line), Some("/b/p.cfg".into()), "{line}");
        }
        assert_eq!(config("python3 /a/klippy/klippy.py -l /c/klippy.log"), None);
        assert_eq!(config("python3 /b/p.cfg"), None);
    }
}
