// SPDX-License-Identifier: GPL-3.0-or-later
//! The VM's files: the package of the present tree, a later package, the host, the tree, and klippy.

use std::env;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use pinion_testkit::{process, simulator};

/// Fills the folder that the VM sees as /share.
pub fn share(folder: &Path) -> Result<(), String> {
    fs::create_dir_all(folder).map_err(|error| format!("{}: {error}", folder.display()))?;
    let tree = Path::new(env!("CARGO_MANIFEST_DIR"));
    let strip =
        |program: &Path, name: &str| process::run(Command::new("strip").arg("-o").arg(folder.join(name)).arg(program));
    // The program that cargo has built for all tests.
    let pinion = Path::new(env!("CARGO_BIN_EXE_pinion"));
    strip(pinion, "pinion")?;
    let simulator = simulator::beside(pinion);
    strip(simulator, "pinion-sim")?;
    fs::create_dir_all(folder.join("deps")).map_err(|error| error.to_string())?;
    strip(&simulator.with_file_name("deps/libpinion_clock.so"), "deps/libpinion_clock.so")?;
    strip(&host(tree)?, "host")?;
    process::run(
        Command::new(tree.join("scripts/build-deb"))
            .arg("--with")
            .arg(folder.join("pinion"))
            .arg(folder)
            // An emulated processor unpacks this in a third of the time.
            .env("DPKG_DEB_COMPRESSOR_TYPE", "zstd")
            .env("DEB_BUILD_OPTIONS", "noautodbgsym")
            // dpkg-buildpackage must run as in a separate shell, not as in make's.
            .env_remove("MAKEFLAGS")
            .env_remove("MAKELEVEL"),
    )?;
    // The later package has another unit and another configuration.
    process::pipeline(
        r#"cd "$1"
           mv pinion-mcu_*.deb pinion-mcu.deb
           mv pinion-sim_*.deb pinion-sim.deb
           dpkg-deb -R pinion-mcu.deb later
           sed -i 's/^Version: .*/&+later/' later/DEBIAN/control
           unit=$(find later -name pinion-mcu.service)
           sed -i 's/^Description=.*/Description=The later unit/' "$unit"
           echo '# of the later package' >>later/usr/share/pinion-mcu/pinion.toml
           dpkg-deb --root-owner-group -Zzstd -b later later.deb
           rm -r later"#,
        &[&folder.display().to_string()],
    )?;
    // The files for `make install`, with the program that is already built.
    process::pipeline(
        r#"cd "$1"; tar -c Makefile systemd udev man docs/guide | tar -x -C "$2" --one-top-level=tree
           install -D -t "$2/tree/target/release" "$2/pinion" "$2/pinion-sim"
           install -D -t "$2/tree/target/release/deps" "$2/deps/libpinion_clock.so""#,
        &[&tree.display().to_string(), &folder.display().to_string()],
    )
}

/// apt repositories as a release has them, signed by a key that is made for this: `apt`, and `apt-next` with the later
/// package. The VM sees them below /share.
pub fn share_repositories(folder: &Path) -> Result<(), String> {
    let scripts = Path::new(env!("CARGO_MANIFEST_DIR")).join("scripts");
    let home = tempfile::tempdir().map_err(|error| format!("a folder for gpg: {error}"))?;
    process::pipeline(
        r#"export GNUPGHOME="$3"
           gpg --batch --quiet --passphrase '' --quick-generate-key 'Test <test@localhost>' ed25519 sign never
           cd "$1"
           mkdir apt apt-next
           cp pinion-mcu.deb pinion-sim.deb apt
           cp later.deb pinion-sim.deb apt-next
           "$2/apt-repository" apt test@localhost file:/srv/pinion-apt
           "$2/apt-repository" apt-next test@localhost file:/srv/pinion-apt
           gpgconf --kill gpg-agent"#,
        &[&folder.display().to_string(), &scripts.display().to_string(), &home.path().display().to_string()],
    )
}

/// klippy from the checkout in KLIPPER_DIR, if it is set. It is for klippy's own checks: see `guest/klippy.sh`. klippy
/// compiles its C library here, because this is also a Debian 12 for x86-64.
pub fn share_klippy(folder: &Path) -> Result<(), String> {
    let tests = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests");
    let ours = ["package/guest/klippy.sh", "klippy/delayed_ssh.py"].map(|path| tests.join(path));
    process::run(Command::new("cp").args(ours).arg(folder))?;
    let Some(checkout) = env::var_os("KLIPPER_DIR") else { return Ok(()) };
    let copy = folder.join("klipper");
    fs::create_dir(&copy).map_err(|error| format!("{}: {error}", copy.display()))?;
    for part in ["klippy", "scripts/flash-linux.sh"] {
        process::run(Command::new("cp").arg("-a").arg(Path::new(&checkout).join(part)).arg(&copy))?;
    }
    let python = env::var_os("KLIPPER_PYTHON").unwrap_or("python3".into());
    process::run(Command::new(python).arg(copy.join("klippy/chelper/__init__.py")))
}

/// Builds the host with cargo, and returns its program.
fn host(tree: &Path) -> Result<PathBuf, String> {
    let mut cargo = Command::new(env::var_os("CARGO").unwrap_or("cargo".into()));
    cargo.current_dir(tree).args(["build", "--locked", "--message-format", "json", "--test", "package_host"]);
    let messages = process::output(&mut cargo)?;
    messages
        .lines()
        .filter_map(|line| serde_json::from_str::<serde_json::Value>(line).ok())
        .filter(|message| message["target"]["name"] == "package_host")
        .find_map(|message| message["executable"].as_str().map(PathBuf::from))
        .ok_or_else(|| "cargo built no package_host".into())
}
