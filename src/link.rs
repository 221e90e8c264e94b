// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion link`: a pty for an MCU on another computer, over ssh.

use std::net::IpAddr;
use std::path::PathBuf;
use std::process::ExitCode;

use clap::{Args, ValueHint};

use pinion_runtime::Target;

use super::{end_by_panic, failed, logging};

/// Options of `pinion link`.
#[derive(Args, Clone, Debug)]
pub(crate) struct LinkArgs {
    /// The MCU's computer, as ssh knows it: HOST, USER@HOST or a name in ~/.ssh/config
    #[arg(value_name = "HOST", value_hint = ValueHint::Hostname, value_parser = host)]
    host: String,
    /// Path of the symbolic link that the host opens here; it leads to the pty [default: /tmp/klipper_host_ and HOST's
    /// name]
    #[arg(short = 'I', long = "link", value_name = "PATH")]
    link: Option<PathBuf>,
    /// The link of the Pinion there
    #[arg(long, value_name = "PATH", default_value = "/tmp/klipper_host_mcu")]
    remote: PathBuf,
    /// ssh, and options for it, such as "ssh -p 2222"
    #[arg(long, value_name = "COMMAND", value_hint = ValueHint::Other, default_value = "ssh")]
    ssh: String,
}

/// ssh would take it for an option.
fn host(text: &str) -> Result<String, String> {
    match text {
        "" => Err("name the computer, such as pi@toolhead.local".into()),
        _ if text.starts_with('-') => Err("a computer's name does not begin with -".into()),
        _ => Ok(text.to_owned()),
    }
}

/// `/tmp/klipper_host_toolhead` for `pi@toolhead.local`. klippy takes a path that begins so for a pty.
fn usual_link(host: &str) -> PathBuf {
    let name = host.rsplit_once('@').map_or(host, |(_, name)| name);
    let name = match name.parse::<IpAddr>() {
        Ok(_) => name,
        Err(_) => name.split('.').next().unwrap_or(name),
    };
    let is_plain = |letter: char| letter.is_ascii_alphanumeric() || "-_.".contains(letter);
    let name: String = name.chars().map(|letter| if is_plain(letter) { letter } else { '_' }).collect();
    format!("/tmp/klipper_host_{name}").into()
}

/// Carries hosts until SIGTERM, SIGINT or SIGHUP.
pub(crate) fn run(args: &LinkArgs) -> ExitCode {
    end_by_panic();
    logging::detach();
    let link = args.link.clone().unwrap_or_else(|| usual_link(&args.host));
    let ssh = args.ssh.split_whitespace().map(str::to_owned).collect();
    let target = Target { ssh, host: args.host.clone(), remote: args.remote.clone() };
    pinion_runtime::link_over_ssh(&link, target).map_or_else(failed, |()| ExitCode::SUCCESS)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_link_is_named_after_the_computer() {
        for (host, link) in [
            ("pi@toolhead.local", "/tmp/klipper_host_toolhead"),
            ("toolhead", "/tmp/klipper_host_toolhead"),
            ("pi@192.168.1.5", "/tmp/klipper_host_192.168.1.5"),
            ("fe80::1", "/tmp/klipper_host_fe80__1"),
            ("../x", "/tmp/klipper_host_"),
        ] {
            assert_eq!(usual_link(host), PathBuf::from(link));
        }
        assert!(host("-oProxyCommand=x").is_err() && host("").is_err());
    }
}
