// SPDX-License-Identifier: GPL-3.0-or-later
//! Somebody's printer.cfg, in files that include each other. A byte 0 begins the next file: `printer.cfg`, `1.cfg`, ...

use std::io;
use std::path::{Path, PathBuf};

use pinion_printer_config::pins::Aliases;
use pinion_printer_config::{Config, Disk, Files, Limit};

struct Memory(Vec<(PathBuf, String)>);

impl Files for Memory {
    fn text(&self, path: &Path) -> io::Result<String> {
        let found = self.0.iter().find(|(name, _)| name == path);
        found.map(|(_, text)| text.clone()).ok_or(io::ErrorKind::NotFound.into())
    }

    fn names(&self, folder: &Path, most: usize) -> Vec<String> {
        let paths = self.0.iter().map(|(path, _)| path);
        let inside = paths.filter(|path| path.parent() == Some(folder));
        inside.filter_map(|path| path.file_name()?.to_str().map(str::to_owned)).take(most).collect()
    }

    fn is_there(&self, path: &Path) -> bool {
        self.0.iter().any(|(name, _)| name == path)
    }

    fn whole(&self, path: &Path) -> PathBuf {
        Disk.whole(path)
    }
}

pub fn run(bytes: &[u8]) {
    let Ok(text) = std::str::from_utf8(bytes) else { return };
    let name = |n: usize| if n == 0 { "printer.cfg".into() } else { format!("{n}.cfg").into() };
    let files: Vec<(PathBuf, String)> =
        text.split('\0').enumerate().map(|(n, text)| (name(n), text.to_owned())).collect();
    let lines: usize = files.iter().map(|(_, text)| text.split(['\n', '\r']).count()).max().unwrap_or(0);
    match Config::read_from(&Memory(files), Path::new("printer.cfg")) {
        Ok(mut config) => {
            config.put_constants_in();
            for section in config.sections() {
                for setting in section.settings() {
                    assert!((1..=lines).contains(&setting.place.line), "{setting:?}");
                    let _ = section.number(&setting.key, Limit::Above(0.0));
                    let _ = section.rows(&setting.key);
                }
            }
            let _ = Aliases::read(&config);
        }
        Err(trouble) => assert!(!trouble.found().contains('\n'), "{trouble}"),
    }
}
