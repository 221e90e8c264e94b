// SPDX-License-Identifier: GPL-3.0-or-later
//! Pinion in the menu of KIAUH, with KIAUH's own code: `KIAUH_DIR` names a checkout of it.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::Command;

use pinion_testkit::here;

/// Finds the extension as KIAUH's menu does, and calls the functions of its entries. The answers come from the standard input.
const MENU: &str = r#"
import sys
from extensions.extensions_menu import ExtensionsMenu, ExtensionSubmenu
extensions = ExtensionsMenu().extensions
ours = [found for found in extensions.values() if found.metadata["display_name"] == "Pinion"]
assert len(ours) == 1, list(extensions)
menu = ExtensionSubmenu(ours[0])
menu.set_options()
menu.print_menu()
menu.options[sys.argv[1]].method()
"#;

/// A program of root's that only prints its arguments.
const SUDO: &str =
    "#!/bin/sh\necho \"$*\" >>\"$SAID\"\ncase $FAILS in ?*) case $* in *$FAILS*) exit 100 ;; esac ;; esac\n";

#[test]
fn pinion_is_in_kiauh_s_menu_of_extensions() {
    let Some(kiauh) = std::env::var_os("KIAUH_DIR") else {
        return here::not_run("it needs a checkout of KIAUH: KIAUH_DIR=~/kiauh");
    };
    let folder = tempfile::tempdir().unwrap();
    let copied = Command::new("cp").arg("-r").arg(Path::new(&kiauh).join("kiauh")).arg(folder.path()).status();
    assert!(copied.unwrap().success());
    let extension = folder.path().join("kiauh/extensions/pinion");
    let own = Path::new(env!("CARGO_MANIFEST_DIR")).join("kiauh/pinion");
    assert!(Command::new("cp").arg("-r").arg(own).arg(&extension).status().unwrap().success());
    let programs = folder.path().join("bin");
    fs::create_dir(&programs).unwrap();
    for (name, script) in [("sudo", SUDO), ("systemctl", "#!/bin/sh\ncase $* in *$ACTIVE*) exit 0 ;; esac\nexit 3\n")] {
        fs::write(programs.join(name), script).unwrap();
        fs::set_permissions(programs.join(name), fs::Permissions::from_mode(0o755)).unwrap();
    }
    let said = folder.path().join("said");
    let choose = |entry: &str, answers: &str, active: &str, fails: &str| {
        let _ = fs::remove_file(&said);
        let path = format!("{}:{}", programs.display(), std::env::var("PATH").unwrap());
        let output = Command::new("sh")
            .args(["-c", "printf \"$0\" | exec python3 -c \"$@\"", answers, MENU, entry])
            .current_dir(folder.path().join("kiauh"))
            .envs([("PATH", path.as_str()), ("ACTIVE", active), ("FAILS", fails)])
            .env("PYTHONPATH", folder.path())
            .env("SAID", &said)
            .env("HOME", folder.path())
            .output()
            .unwrap();
        let shown = String::from_utf8_lossy(&output.stdout).into_owned();
        assert!(output.status.success(), "{shown}{}", String::from_utf8_lossy(&output.stderr));
        (shown, fs::read_to_string(&said).unwrap_or_default().replace("env DEBIAN_FRONTEND=noninteractive ", ""))
    };
    let (install, update, remove) = ("1", "2", "3");
    let user = nix::unistd::User::from_uid(nix::unistd::getuid()).unwrap().unwrap().name;
    let (shown, commands) = choose(install, "\\n", "none", "");
    let installed = format!("apt-get update\napt-get install -y pinion-mcu\nusermod -aG tty {user}\n");
    assert_eq!(commands, format!("{installed}systemctl enable --now pinion-mcu.service\n"), "{shown}");
    // Klipper's own program is in use.
    assert_eq!(choose(install, "\\n", "klipper-mcu.service", "").1, installed);
    // A release has apt's source beside it.
    for name in ["pinion.sources", "pinion.asc"] {
        fs::write(extension.join(name), "").unwrap();
    }
    let commands = choose(install, "n\\n", "none", "").1;
    assert!(commands.contains("/pinion.sources /etc/apt/sources.list.d/pinion.sources\n"), "{commands}");
    assert!(commands.ends_with(&installed), "{commands}");
    let (shown, _) = choose(install, "\\n", "none", "apt-get install");
    assert!(shown.contains("apt-get install -y pinion-mcu: exit status 100"), "{shown}");

    // Nothing restarts unless the user says so.
    let updated = "apt-get update\napt-get install -y --only-upgrade pinion-mcu\n";
    assert_eq!(choose(update, "\\n", "pinion-mcu.service", "").1, updated);
    let commands = choose(update, "y\\n", "pinion-mcu.service", "").1;
    assert_eq!(commands, format!("{updated}systemctl restart pinion-mcu.service\n"));

    assert_eq!(choose(remove, "\\n", "pinion-mcu.service", "").1, "");
    let (shown, commands) = choose(remove, "y\\n", "pinion-mcu.service", "");
    assert!(commands.starts_with("apt-get remove -y pinion-mcu\n"), "{commands}");
    assert!(shown.contains("Remove [mcu host]"), "{shown}");
}
