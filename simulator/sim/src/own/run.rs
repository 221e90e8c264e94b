// SPDX-License-Identifier: GPL-3.0-or-later
//! `pinion sim PRINTER.CFG`: its printer, its folder, and what the user does next.

use std::ffi::OsStr;
use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use nix::unistd::geteuid;
use pinion_linux::foreign::plain;
use pinion_linux::own_folder::OwnFolder;
use pinion_printer_config::Trouble;
use pinion_printer_config::pins::section_of;
use toml::Table;

use super::args::OwnArgs;
use super::klippy::Klippy;
use super::serve::{Folder, Own, Reading};
use super::translate::check;
use crate::description::text;

/// Whether a file is klippy's configuration, and no description.
pub(crate) fn is_printer_cfg(path: &Path) -> bool {
    path.extension() == Some(OsStr::new("cfg"))
}

/// Reads a printer.cfg with the options of the command line, and says what a user should know.
///
/// # Errors
///
/// It is no printer, or has a mistake.
pub(crate) fn read(path: &Path, args: &OwnArgs) -> Result<Own, Trouble> {
    let over = args.with.as_deref().map(table).transpose()?;
    let klippy = Klippy::of(args);
    let klipper = args.klipper();
    let reading = Reading {
        built_like: args.built_like.as_deref(),
        over,
        pace: args.pace(),
        without_plugins: args.without_plugins,
        klipper: klipper.as_deref(),
        is_checked: klippy.is_none(),
    };
    let own = Own::read(path, reading)?;
    if let Some(klippy) = klippy
        && !klippy.judge(&own)?
    {
        check(&own.config)?;
    }
    own.notes.iter().for_each(|note| log::warn!("{note}"));
    Ok(own)
}

/// A description that lies over another one.
fn table(path: &Path) -> Result<Table, Trouble> {
    let text = text(path)?;
    text.parse().map_err(|error: toml::de::Error| {
        let byte = error.span().map_or(0, |span| span.start);
        Trouble::new(error.message().replace('\n', " ")).remedy("correct it").at(path.display(), &text, byte)
    })
}

/// Where klippy finds the MCUs: in a folder with its copy, or where its configuration expects them.
pub(crate) enum Place {
    Folder(Folder),
    InPlace(Vec<PathBuf>),
}

impl Place {
    /// Makes the folder, or checks the paths. `link` is the command line's path of the main MCU.
    ///
    /// # Errors
    ///
    /// The folder cannot be made, or a path is no place for a link.
    pub(crate) fn make(own: &Own, args: &OwnArgs, link: Option<&Path>) -> Result<Place, Trouble> {
        if args.in_place_pty {
            return own.mcus.iter().map(|mcu| in_place(own, mcu)).collect::<Result<_, _>>().map(Place::InPlace);
        }
        if let Some(klipper) = args.klipper().filter(|klipper| args.without_plugins && !is_checkout(klipper)) {
            let trouble = Trouble::new("it has no klippy/klippy.py").of(klipper.display());
            return Err(trouble.remedy("name a checkout of Klipper or Kalico with --klipper"));
        }
        if !own.left_out.sections.is_empty() {
            log::info!("klippy's copy is without [{}]", own.left_out.sections.join("], ["));
        }
        Folder::make(own, args.folder.as_deref(), link).map(Place::Folder)
    }

    /// The links of all MCUs, the main one's first.
    pub(crate) fn links(&self) -> &[PathBuf] {
        match self {
            Place::InPlace(links) => links,
            Place::Folder(folder) => &folder.links,
        }
    }

    /// The user's next step, as lines.
    pub(crate) fn next(&self, args: &OwnArgs) -> Vec<String> {
        match self {
            Place::Folder(folder) => vec![
                format!("The printer waits for klippy. Its copy of printer.cfg is {}:", folder.printer_cfg.display()),
                format!("  {}", folder.command(args.klipper().as_deref())),
            ],
            Place::InPlace(links) => {
                let links: Vec<String> = links.iter().map(|link| link.display().to_string()).collect();
                vec![format!("The printer waits for klippy at {}.", plain(&links.join(" and ")))]
            }
        }
    }
}

fn is_checkout(klipper: &Path) -> bool {
    klipper.join("klippy/klippy.py").is_file()
}

/// The path where klippy expects an MCU.
fn in_place(own: &Own, mcu: &str) -> Result<PathBuf, Trouble> {
    let name = section_of(mcu);
    let section = own.config.section(&name).ok_or_else(|| Trouble::new(format!("there is no [{name}]")))?;
    let path = PathBuf::from(section.required("serial")?);
    let refused = |cause: &str| {
        let remedy = "leave --in-place-pty out, or set `serial` to a path in /tmp";
        Err(section.trouble("serial", format!("{}: {cause}", path.display())).remedy(remedy))
    };
    if !path.is_absolute() {
        return refused("it is not a place for a link");
    }
    // The folder that it leads to by now, without `..` and links.
    let folder = path.parent().unwrap_or(Path::new("/"));
    let real = match OwnFolder::open(folder).and_then(|folder| fs::canonicalize(folder.at("."))) {
        Ok(real) => real,
        Err(error) => return refused(&error.to_string()),
    };
    if ["/dev", "/sys", "/proc"].iter().any(|kernels| real.starts_with(kernels)) {
        return refused("it is not a place for a link");
    }
    let Some(name) = path.file_name() else { return refused("it is not a place for a link") };
    let path = real.join(name);
    match fs::symlink_metadata(&path) {
        Ok(about) if !about.is_symlink() => refused("something else is there"),
        Ok(about) if about.uid() != geteuid().as_raw() => refused("the link there belongs to another user"),
        _ => Ok(path),
    }
}
