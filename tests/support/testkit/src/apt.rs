// SPDX-License-Identifier: GPL-3.0-or-later
//! apt with its own state, below a cache. It needs no root, and the computer's dpkg learns nothing of its architecture and
//! its packages. It takes the archives and their keys from the computer's configuration.

use std::ffi::OsString;
use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use super::{describe, process};

/// The package lists are renewed when they are older than this.
const LISTS_AGE_MAX: Duration = Duration::from_secs(24 * 3600);

/// The releases of Debian's archives that are used: the suite itself, its updates, its security updates.
const UPDATES: [&str; 2] = ["updates", "security"];

const SOURCES: &str = "sources.list";

/// apt for one architecture and one release of Debian.
pub struct Apt {
    config: PathBuf,
    folder: PathBuf,
    of: String,
}

impl Apt {
    /// `folder` keeps its state. `architecture` is Debian's name, such as arm64. `release` is a release's code name such
    /// as bookworm; `None` is the release of this computer.
    pub fn open(folder: &Path, architecture: &str, release: Option<&str>) -> Result<Apt, String> {
        for part in ["lists/partial", "archives/partial"] {
            let part = folder.join(part);
            fs::create_dir_all(&part).map_err(|error| describe("create", &part, &error))?;
        }
        // apt's own tools change their folder.
        let folder = folder.canonicalize().map_err(|error| describe("read", folder, &error))?;
        let path = folder.to_str().ok_or_else(|| format!("{} is not UTF-8", folder.display()))?;
        // As root, apt downloads as a user of its own, who may not reach the cache.
        let mut text = format!(
            r#"APT::Architecture "{architecture}";
               APT::Architectures {{ "{architecture}"; }};
               APT::Sandbox::User "";
               APT::Install-Recommends "false";
               Acquire::Languages "none";
               Acquire::IndexTargets::deb::DEP-11::DefaultEnabled "false";
               Dir::State "{path}";
               Dir::State::status "{path}/status";
               Dir::Cache "{path}";
            "#
        );
        let (config, status) = (folder.join("apt.conf"), folder.join("status"));
        let write =
            |file: &Path, content: &str| fs::write(file, content).map_err(|error| describe("write", file, &error));
        if let Some(release) = release {
            write(&folder.join(SOURCES), &sources_of(release)?)?;
            text += &format!("Dir::Etc::sourcelist \"{path}/{SOURCES}\";\nDir::Etc::sourceparts \"/dev/null\";\n");
        }
        write(&config, &text)?;
        write(&status, "")?;
        let of = format!("{} {architecture}", release.unwrap_or("this computer's release for"));
        let apt = Apt { config, folder, of };
        apt.update_if_old()?;
        Ok(apt)
    }

    /// Updates the lists, unless that was done within [`LISTS_AGE_MAX`]. Without a network the old lists remain in use.
    fn update_if_old(&self) -> Result<(), String> {
        let age = fs::metadata(self.stamp()).and_then(|stamp| stamp.modified()).map(|time| time.elapsed());
        if matches!(age, Ok(Ok(age)) if age < LISTS_AGE_MAX) {
            return Ok(());
        }
        let Err(cause) = self.update() else { return Ok(()) };
        // apt's own words, without the whole command.
        let why = cause.lines().find(|line| line.starts_with("E: ")).unwrap_or(&cause);
        let away = format!("Debian's archives for {} cannot be reached ({why})", self.of);
        if !self.stamp().exists() {
            return Err(format!("{away}: connect to a network, or correct /etc/apt/sources.list"));
        }
        eprintln!("{away}: the packages that were known before are used");
        Ok(())
    }

    /// Updates the lists now.
    pub fn update(&self) -> Result<(), String> {
        let mut update = self.command("apt-get");
        // By default apt only warns of archives that it cannot reach.
        process::run(update.args(["update", "-qq", "-o", "APT::Update::Error-Mode=any"]))?;
        File::create(self.stamp()).map(drop).map_err(|error| describe("create", &self.stamp(), &error))
    }

    /// The archives of another release, as a sources.list.
    pub fn sources(&self) -> PathBuf {
        self.folder.join(SOURCES)
    }

    fn stamp(&self) -> PathBuf {
        self.folder.join("updated")
    }

    /// One of apt's programs, such as `apt-get`.
    pub fn command(&self, program: &str) -> Command {
        let mut command = Command::new(program);
        command.env("APT_CONFIG", &self.config);
        command
    }
}

/// The computer's archives, for another release: lines of a sources.list.
fn sources_of(release: &str) -> Result<String, String> {
    let mut ask = Command::new("apt-get");
    ask.args(["indextargets", "--format", "$(REPO_URI) $(RELEASE) $(COMPONENT)", "Created-By: Packages"]);
    let targets = process::output(&mut ask)?;
    let mut lines: Vec<String> = targets.lines().filter_map(|target| source_of(target, release)).collect();
    lines.sort();
    lines.dedup();
    Ok(lines.concat())
}

/// A line for `release`, from the archive, release and component of a target. `None` if it is of another kind.
fn source_of(target: &str, release: &str) -> Option<String> {
    let mut words = target.split(' ');
    let (uri, of, component) = (words.next()?, words.next()?, words.next()?);
    let suffix = match of.split_once('-') {
        None => String::new(),
        Some((_, kind)) if UPDATES.contains(&kind) => format!("-{kind}"),
        Some(_) => return None,
    };
    Some(format!("deb {uri} {release}{suffix} {component}\n"))
}

/// An option of apt with a path, such as `Dir::Cache::archives`.
pub fn option(name: &str, path: &Path) -> OsString {
    let mut option = OsString::from(format!("{name}="));
    option.push(path);
    option
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_archives_of_a_computer_serve_another_release() {
        for (target, line) in [
            ("http://mirror/debian/ trixie main", Some("deb http://mirror/debian/ bookworm main\n")),
            ("http://mirror/debian/ stable-updates main", Some("deb http://mirror/debian/ bookworm-updates main\n")),
            ("http://mirror/s/ trixie-security contrib", Some("deb http://mirror/s/ bookworm-security contrib\n")),
            ("http://mirror/debian/ trixie-backports main", None),
            ("", None),
        ] {
            assert_eq!(source_of(target, "bookworm").as_deref(), line, "{target}");
        }
    }
}
