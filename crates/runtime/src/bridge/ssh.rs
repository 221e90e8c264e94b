// SPDX-License-Identifier: GPL-3.0-or-later
//! ssh as a child: keys, encryption and accounts are its own.

use std::io;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::path::PathBuf;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::thread;
use std::time::Duration;

use nix::fcntl::{FcntlArg, OFlag, fcntl};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

use pinion_firmware::trouble::Trouble;
use pinion_linux::clock::monotonic;

use super::{Incoming, SILENCE_MAX, Wire, read_some};
use crate::trouble::refused;

/// ssh's options. It never asks a person. Its own packets for a network that has gone end it as soon as the bridge
/// would. `ef` is for Wi-Fi: without a terminal ssh asks for the class of bulk data, which waits for all others.
const OPTIONS: [&str; 13] = [
    "-T",
    "-o",
    "BatchMode=yes",
    "-o",
    "LogLevel=ERROR",
    "-o",
    "ConnectTimeout=10",
    "-o",
    "ServerAliveInterval=2",
    "-o",
    "ServerAliveCountMax=3",
    "-o",
    "IPQoS=ef",
];
/// ssh's own exit status if the connection fails, or if the command at the other end cannot start.
const SSH_FAILED: i32 = 255;
/// A shell's exit status for a command that is not there.
const NOT_FOUND: i32 = 127;
/// How long ssh may take to end.
const END_MAX: Duration = Duration::from_secs(2);
/// How often to check whether it has ended.
const LOOK: Duration = Duration::from_millis(10);
/// Longest part of its messages that is kept. The last one counts.
const MESSAGES_BYTES: usize = 4096;

/// Where to connect to, and how.
#[derive(Clone, Debug)]
pub struct Target {
    /// ssh, and options for it.
    pub ssh: Vec<String>,
    /// The other computer, as ssh knows it: `[USER@]HOST`, or a name in its configuration.
    pub host: String,
    /// The link of the Pinion there.
    pub remote: PathBuf,
}

/// The options of ssh that ssh-copy-id has too, each with a value (ssh-copy-id(1)).
const COPY_ID_OPTIONS: [&str; 4] = ["-p", "-i", "-o", "-F"];

impl Target {
    /// The command by which a person logs in there in the same way.
    fn by_hand(&self) -> String {
        let ssh = if self.ssh.is_empty() { "ssh".to_owned() } else { self.ssh.join(" ") };
        format!("{ssh} {}", self.host)
    }

    /// How to put the user's key there.
    fn copy_id(&self) -> String {
        let mut command = "ssh-copy-id".to_owned();
        let mut words = self.ssh.iter().skip(1);
        while let Some(word) = words.next() {
            let is_known = word.get(..2).is_some_and(|option| COPY_ID_OPTIONS.contains(&option));
            let value = if word.len() == 2 { words.next() } else { None };
            if !is_known {
                return format!(
                    "add this user's key (~/.ssh/*.pub) to ~/.ssh/authorized_keys there, by {}",
                    self.by_hand()
                );
            }
            for word in [Some(word), value].into_iter().flatten() {
                command += " ";
                command += word;
            }
        }
        format!("{command} {}, as this user", self.host)
    }

    fn command(&self) -> Command {
        let (program, options) = self.ssh.split_first().map_or(("ssh", &[][..]), |(first, rest)| (first, rest));
        let mut command = Command::new(program);
        command.args(options).args(OPTIONS).arg("--").arg(&self.host);
        // A shell there reads the command.
        let remote = self.remote.display().to_string().replace('\'', r"'\''");
        command.arg(format!("exec pinion attach -I '{remote}'"));
        command
    }

    /// Starts ssh.
    pub(super) fn connect(&self) -> Result<Ssh, Trouble> {
        let mut command = self.command();
        let started = command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn();
        let cannot = |error: io::Error| {
            refused(format_args!("{} cannot be started", command.get_program().display()), error)
                .remedy("sudo apt install openssh-client, or name it with --ssh")
        };
        let mut child = started.map_err(&cannot)?;
        let (Some(input), Some(output), Some(messages)) =
            (child.stdout.take(), child.stdin.take(), child.stderr.take())
        else {
            return Err(cannot(io::ErrorKind::BrokenPipe.into()));
        };
        let messages = OwnedFd::from(messages);
        let prepared = fcntl(&messages, FcntlArg::F_SETFL(OFlag::O_NONBLOCK)).map_err(io::Error::from);
        let wire = prepared.and_then(|_| Wire::new(input.into(), output.into())).map_err(cannot)?;
        Ok(Ssh { child, wire: Some(wire), messages: Messages { fd: Some(messages), text: Vec::new() } })
    }
}

/// A running ssh. Dropping it ends it.
pub(super) struct Ssh {
    child: Child,
    /// `None` when it shall end.
    wire: Option<Wire>,
    messages: Messages,
}

/// Messages of ssh and of the other end.
struct Messages {
    fd: Option<OwnedFd>,
    text: Vec<u8>,
}

impl Ssh {
    pub(super) fn wire(&mut self) -> Option<&mut Wire> {
        self.wire.as_mut()
    }

    /// The descriptors of its output and its input.
    pub(super) fn events(&self) -> Option<[BorrowedFd<'_>; 2]> {
        self.wire.as_ref().map(|wire| [wire.input.as_fd(), wire.output.as_fd()])
    }

    /// The descriptor of its messages. `None` if there will be no more.
    pub(super) fn messages(&self) -> Option<BorrowedFd<'_>> {
        self.messages.fd.as_ref().map(AsFd::as_fd)
    }

    /// Takes in its messages.
    pub(super) fn listen(&mut self) {
        let Messages { fd, text } = &mut self.messages;
        let mut buffer = [0; MESSAGES_BYTES];
        while let Some(open) = fd {
            match read_some(open, &mut buffer) {
                Ok(Incoming::Bytes(0)) => return,
                Ok(Incoming::Bytes(bytes)) => {
                    text.extend_from_slice(&buffer[..bytes]);
                    text.drain(..text.len().saturating_sub(MESSAGES_BYTES));
                }
                Ok(Incoming::Over) | Err(_) => *fd = None,
            }
        }
    }

    /// Lets it end: the host is gone, and the other end has to see that. Then it is waited for, so that the terminal
    /// there is free for the next one.
    pub(super) fn end(mut self) {
        self.wire = None;
        let _ = self.wait();
    }

    /// Why it has ended, or had to be.
    pub(super) fn verdict(mut self, target: &Target) -> Trouble {
        let is_silent = self.wire.as_ref().is_some_and(Wire::is_silent);
        self.wire = None;
        let status = if is_silent { None } else { self.wait() };
        self.listen();
        let host = target.host.as_str();
        if is_silent {
            let cause = format!("it has said nothing for {} s", SILENCE_MAX.as_secs());
            return Trouble::new(cause).of(host).remedy("look at its network and at its power");
        }
        judge(&String::from_utf8_lossy(&self.messages.text), status, target)
    }

    /// Its exit status, if it ends in time.
    fn wait(&mut self) -> Option<ExitStatus> {
        let end = monotonic() + END_MAX;
        loop {
            match self.child.try_wait() {
                Ok(None) if monotonic() < end => thread::sleep(LOOK),
                Ok(status) => return status,
                Err(_) => return None,
            }
        }
    }
}

impl Drop for Ssh {
    fn drop(&mut self) {
        if let (Ok(None), Ok(pid)) = (self.child.try_wait(), i32::try_from(self.child.id())) {
            let _ = kill(Pid::from_raw(pid), Signal::SIGTERM);
            if self.wait().is_none() {
                let _ = self.child.kill();
                let _ = self.child.wait();
            }
        }
    }
}

/// Makes one line of the messages and the exit status.
fn judge(messages: &str, status: Option<ExitStatus>, target: &Target) -> Trouble {
    let host = target.host.as_str();
    let last = messages.lines().map(|line| line.trim().trim_end_matches('.')).rfind(|line| !line.is_empty());
    let last = last.map(|line| line.strip_prefix(host).and_then(|line| line.strip_prefix(": ")).unwrap_or(line));
    // The other end's log line begins with the time and the level.
    if let Some((_, line)) = last.and_then(|line| line.split_once("] ERROR ")) {
        return Trouble::new(line.to_owned()).of(host);
    }
    let code = status.and_then(|status| status.code());
    let cause = last.map_or_else(
        || status.map_or_else(|| "ssh does not end".into(), |status| format!("ssh ended ({status})")),
        str::to_owned,
    );
    let remedy = match code {
        Some(NOT_FOUND) => "install the package pinion-mcu there".to_owned(),
        Some(SSH_FAILED) if cause.contains("Host key verification failed") => {
            format!("{} once by hand, as this user, and compare its key", target.by_hand())
        }
        Some(SSH_FAILED) if cause.contains("Permission denied") => target.copy_id(),
        Some(SSH_FAILED) if cause.contains("Could not resolve") => "correct the name, or use its address".to_owned(),
        _ => format!("try {} by hand, as this user", target.by_hand()),
    };
    Trouble::new(cause).of(host).remedy(remedy)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::process::ExitStatusExt;

    fn target(ssh: &str) -> Target {
        let ssh = ssh.split_whitespace().map(str::to_owned).collect();
        Target { ssh, host: "pi@toolhead".into(), remote: "/tmp/it's".into() }
    }

    #[test]
    fn ssh_gets_its_options_the_user_s_and_a_quoted_command() {
        let command = target("ssh -p 2222").command();
        let words: Vec<_> = command.get_args().map(|word| word.to_string_lossy()).collect();
        // ssh takes the first value of an option, so the user's come first.
        assert_eq!(words[..5], ["-p", "2222", "-T", "-o", "BatchMode=yes"]);
        assert_eq!(words[15..], ["--", "pi@toolhead", r"exec pinion attach -I '/tmp/it'\''s'"]);
    }

    #[test]
    fn a_failure_is_one_line_with_its_remedy() {
        let explained = |messages: &str, code: i32| {
            judge(messages, Some(ExitStatus::from_raw(code << 8)), &target("ssh")).to_string()
        };
        for (messages, code, line) in [
            (
                "Host key verification failed.\r\n",
                255,
                "pi@toolhead: Host key verification failed: ssh pi@toolhead once by hand, as this user, and compare its key",
            ),
            (
                "pi@toolhead: Permission denied (publickey).\n",
                255,
                "pi@toolhead: Permission denied (publickey): ssh-copy-id pi@toolhead, as this user",
            ),
            (
                "sh: 1: exec: pinion: not found\n",
                127,
                "pi@toolhead: sh: 1: exec: pinion: not found: install the package pinion-mcu there",
            ),
            ("[    12.3] ERROR /tmp/x: it is gone: start it\n", 1, "pi@toolhead: /tmp/x: it is gone: start it"),
            ("", 255, "pi@toolhead: ssh ended (exit status: 255): try ssh pi@toolhead by hand, as this user"),
        ] {
            assert_eq!(explained(messages, code), line);
        }
    }

    #[test]
    fn a_remedy_has_the_options_of_ssh() {
        let explained = |ssh: &str, messages: &str| {
            let trouble = judge(messages, Some(ExitStatus::from_raw(SSH_FAILED << 8)), &target(ssh));
            trouble.remedy.unwrap().into_string()
        };
        let unknown_key = "Host key verification failed.";
        let denied = "pi@toolhead: Permission denied (publickey).";
        assert_eq!(explained("ssh -p 2222", ""), "try ssh -p 2222 pi@toolhead by hand, as this user");
        assert_eq!(
            explained("/opt/ssh -p2222", unknown_key),
            "/opt/ssh -p2222 pi@toolhead once by hand, as this user, and compare its key"
        );
        let options = "-p 2222 -i /home/pi/key -oProxyJump=gate";
        assert_eq!(
            explained(&format!("ssh {options}"), denied),
            format!("ssh-copy-id {options} pi@toolhead, as this user")
        );
        // ssh-copy-id does not have these.
        for options in ["-J gate", "-4", "-v -p 2222"] {
            assert_eq!(
                explained(&format!("ssh {options}"), denied),
                format!(
                    "add this user's key (~/.ssh/*.pub) to ~/.ssh/authorized_keys there, by ssh {options} pi@toolhead"
                )
            );
        }
    }
}
