// SPDX-License-Identifier: GPL-3.0-or-later
//! klippy for the guest, from a checkout of the computer.

use std::env;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use pinion_testkit::initramfs::Archive;
use pinion_testkit::process;

/// Imports what klippy can import in the folder of its first argument. Prints Python, its search path, and the files of
/// all modules.
const IMPORT_ALL: &str = r#"
import importlib, os, sys
folder = sys.argv[1]
sys.path.insert(0, folder)
sys.modules["numpy"] = sys.modules["scipy"] = None
import klippy, chelper, jinja2
chelper.get_ffi()
jinja2.Environment("{%", "%}", "{", "}").from_string("{% if 'a' in text %}{text}\n{% endif %}").render(text="a")
for package in ("extras", "kinematics"):
    for name in sorted(os.listdir(os.path.join(folder, package))):
        try:
            importlib.import_module(package + "." + name.removesuffix(".py"))
        except Exception:
            pass
print(os.path.realpath(sys.executable))
print(":".join(path for path in sys.path if "site-packages" in path))
for module in list(sys.modules.values()):
    for file in (getattr(module, "__file__", None), getattr(module, "__cached__", None)):
        if file and os.path.isfile(file) and not file.startswith(folder):
            print(file)
"#;

/// The path of the file that says where klippy is: Python, its search path and klippy's folder.
const PLACES: &str = "/tests/klippy";

/// klippy, Python and its modules. Their paths are the same in the guest.
pub struct Klippy {
    python: PathBuf,
    search_path: String,
    folder: PathBuf,
    files: Vec<PathBuf>,
}

impl Klippy {
    /// The klippy of KLIPPER_DIR with the Python of KLIPPER_PYTHON, if they are set.
    pub fn of_environment() -> Result<Option<Klippy>, String> {
        let Some(checkout) = env::var_os("KLIPPER_DIR") else { return Ok(None) };
        let folder = fs::canonicalize(Path::new(&checkout).join("klippy"))
            .map_err(|error| format!("KLIPPER_DIR={} has no klippy: {error}", checkout.display()))?;
        let python = env::var_os("KLIPPER_PYTHON").unwrap_or("python3".into());
        let list = process::output(Command::new(python).args(["-c", IMPORT_ALL]).arg(&folder))?;
        let mut lines = list.lines();
        let mut line = || lines.next().map(str::to_owned).ok_or("Python printed no list of modules");
        let (python, search_path) = (PathBuf::from(line()?), line()?);
        let mut files = files_below(&folder)?;
        files.extend([python.clone()].into_iter().chain(lines.map(PathBuf::from)));
        Ok(Some(Klippy { python, search_path, folder, files }))
    }

    /// Programs and libraries that need libraries.
    pub fn programs(&self) -> impl Iterator<Item = &Path> {
        let is_library = |path: &&PathBuf| path.extension().is_some_and(|extension| extension == "so");
        [&self.python].into_iter().chain(self.files.iter().filter(is_library)).map(PathBuf::as_path)
    }

    pub fn files(&self) -> impl Iterator<Item = &Path> {
        self.files.iter().map(PathBuf::as_path)
    }

    /// Adds it to the guest's root folder.
    pub fn add_to(&self, archive: &mut Archive) -> Result<(), String> {
        let text = |path: &Path| path.to_str().map(str::to_owned).ok_or(format!("{} is not text", path.display()));
        for file in &self.files {
            archive.copy(&text(file)?, file)?;
        }
        let places = format!("{}\n{}\n{}\n", text(&self.python)?, self.search_path, text(&self.folder)?);
        archive.file(PLACES, places.as_bytes());
        Ok(())
    }
}

fn files_below(folder: &Path) -> Result<Vec<PathBuf>, String> {
    let describe = |error| format!("cannot read {}: {error}", folder.display());
    let mut files = Vec::new();
    for entry in fs::read_dir(folder).map_err(describe)? {
        let path = entry.map_err(describe)?.path();
        match path.is_dir() {
            true => files.extend(files_below(&path)?),
            false => files.push(path),
        }
    }
    Ok(files)
}
