// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion attach`: the far end of `pinion link`.

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::Args;

use pinion_runtime::attach;

use super::console::hosts;
use super::failed;

/// Options of `pinion attach`.
#[derive(Args, Clone, Debug)]
pub(crate) struct AttachArgs {
    /// The link of the running Pinion
    #[arg(short = 'I', value_name = "PATH", default_value = "/tmp/klipper_host_mcu")]
    link: PathBuf,
}

/// Carries bytes until the terminal or the input ends.
pub(crate) fn run(args: &AttachArgs) -> ExitCode {
    // Processes that may not be looked into count as nobody: a user with no more than the group has to get in.
    let attached = hosts(&args.link).and_then(|_hidden| carry(&args.link));
    attached.map_or_else(failed, |()| ExitCode::SUCCESS)
}

fn carry(link: &Path) -> Result<(), String> {
    attach(link).map_err(|trouble| trouble.to_string())
}
