// SPDX-License-Identifier: GPL-3.0-or-later
//! Whether this computer lets a test run, and what the test then sees of it.

use std::env;
use std::fs;
use std::io::{self, Write};
use std::os::unix::fs::MetadataExt;
use std::process::{Command, Stdio};
use std::thread;

/// Set in a test that [`among_own_processes`] has started.
const ALONE: &str = "PINION_TEST_ALONE";

/// Says that the present test is not run, and why. libtest hides what a test prints, so this bypasses it.
pub fn not_run(why: &str) {
    let test = thread::current().name().unwrap_or("a test").to_owned();
    let _ = writeln!(io::stderr(), "\nNOT RUN: {test}: {why}");
}

/// Whether the test may mount in a namespace of its own. If not, this says that the test is not run.
pub fn may_mount() -> bool {
    let allowed = succeeds(Command::new("unshare").args(["--mount", "true"]));
    if !allowed {
        not_run("it mounts file systems, which takes root, and a container that permits it");
    }
    allowed
}

/// Whether the test may give files to another user. If not, this says that the test is not run.
pub fn is_root() -> bool {
    let is_root = fs::metadata("/proc/self").is_ok_and(|about| about.uid() == 0);
    if !is_root {
        not_run("it gives files to another user, which takes root");
    }
    is_root
}

/// Runs the test's body in a PID namespace, so that it sees no process of the computer but its own. This takes a second
/// process with the same test. Where namespaces are not permitted, the test says that it is not run.
pub fn among_own_processes(test: &str, body: impl FnOnce()) {
    if env::var_os(ALONE).is_some() {
        return body();
    }
    let namespaces = |arguments: &[&str]| {
        let mut unshare = Command::new("unshare");
        unshare.args(arguments).args(["--pid", "--fork", "--kill-child", "--mount-proc"]);
        unshare
    };
    // An ordinary user needs a user namespace, and may be root in it only.
    let permitted = [&[][..], &["--user", "--map-root-user"]]
        .into_iter()
        .find(|arguments| succeeds(namespaces(arguments).arg("true")));
    let Some(arguments) = permitted else {
        return not_run("it needs a PID namespace, which this computer does not permit");
    };
    let this = env::current_exe().expect("a running program has a path");
    let ended = namespaces(arguments)
        .arg(this)
        .args(["--exact", test, "--nocapture", "--test-threads=1"])
        .env(ALONE, "yes")
        .output()
        .expect("it was started before");
    let text = format!("{}{}", String::from_utf8_lossy(&ended.stdout), String::from_utf8_lossy(&ended.stderr));
    assert!(ended.status.success() && text.contains("1 passed"), "{text}");
}

fn succeeds(command: &mut Command) -> bool {
    let ended = command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null()).status();
    ended.is_ok_and(|status| status.success())
}
