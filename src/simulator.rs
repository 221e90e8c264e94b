// SPDX-License-Identifier: GPL-3.0-or-later
//! The way to the simulated boards. They are in another program, `pinion-sim`, which takes the place of this one.

use std::ffi::{OsStr, OsString};
use std::io;
use std::os::unix::process::CommandExt as _;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;

use pinion_firmware::board::Board;
use pinion_firmware::time::{TimeSource, Timing};
use pinion_firmware::trouble::Trouble;
use pinion_system::settings::run_args;

/// Makes the simulated board of a description, or the built-in one.
pub type Open = fn(Option<&Path>, Arc<dyn TimeSource>) -> Result<(Box<dyn Board>, Timing), Trouble>;

const PROGRAM: &str = "pinion-sim";
/// The subcommands that `pinion-sim` has, too.
const COMMANDS: [&str; 3] = ["run", "dict", "console"];

/// `pinion`'s own [`Open`]: `pinion-sim` does this process's command from here on. It returns only if that fails.
pub(crate) fn take_over(_: Option<&Path>, _: Arc<dyn TimeSource>) -> Result<(Box<dyn Board>, Timing), Trouble> {
    let mut arguments: Vec<OsString> = std::env::args_os().skip(1).collect();
    let is_run = run_args(std::env::args_os()).is_ok_and(|run| run.is_some());
    if is_run && !arguments.iter().any(|word| COMMANDS.iter().any(|command| word == command)) {
        arguments.insert(0, "run".into());
    }
    Err(start(&arguments))
}

/// Starts `pinion-sim` in this process. It returns only if that fails.
pub(crate) fn start(arguments: &[OsString]) -> Trouble {
    let beside = std::env::current_exe().ok().and_then(|program| beside(&program));
    let program = beside.as_deref().map_or(OsStr::new(PROGRAM), Path::as_os_str);
    let error = Command::new(program).args(arguments).exec();
    let remedy = "sudo apt install pinion-sim, or in the sources: make build";
    match error.kind() {
        io::ErrorKind::NotFound => {
            Trouble::new(format!("the simulated printer is the program {PROGRAM}, which is not installed"))
        }
        _ => Trouble::new(error.to_string()).of(Path::new(program).display()),
    }
    .remedy(remedy)
}

/// The program in the folder of another one.
fn beside(program: &Path) -> Option<PathBuf> {
    Some(program.parent()?.join(PROGRAM)).filter(|program| program.is_file())
}
