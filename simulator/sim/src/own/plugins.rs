// SPDX-License-Identifier: GPL-3.0-or-later
//! The sections that klippy's copy is without: those of plugins that klippy does not have, and what hangs on them.

use std::fs;
use std::path::{Path, PathBuf};

use pinion_linux::foreign;
use pinion_printer_config::{Config, Limit, Section, Trouble};

use super::known::{MAKES_PROBE, is_numbered, lacks_module, motor_of, near};
use super::sensors::is_known;

/// The probes of plugins. Others are known by their offsets.
const PROBES: [&str; 7] = ["beacon", "cartographer", "scanner", "idm", "probe_eddy_ng", "tool_probe", "btt_eddy"];
/// The steppers of klippy's kinematics, without their numbers.
const STEPPERS: [&str; 10] = ["x", "y", "z", "a", "b", "c", "left", "right", "bed", "arm"];
/// The height of a stand-in above the nozzle, if the plugin's section has no `z_offset`.
const Z_OFFSET_MM: f64 = 1.0;
/// The pin of a stand-in, on the main MCU.
pub(super) const PIN: &str = "pinion_stand_in";
/// The sections of the file that Mainsail and Fluidd bring along.
const OF_INTERFACE: &str = "[virtual_sdcard]\npath: ~/printer_data/gcodes\non_error_gcode: CANCEL_PRINT\n\
                            [pause_resume]\n[display_status]\n[respond]\n";
/// Longest source of klippy.
const SOURCE_MAX: u64 = 4 << 20;

/// The sections and options that a copy is without.
#[derive(Clone, Debug, Default)]
pub(super) struct LeftOut {
    /// The whole names of the sections.
    pub(super) sections: Vec<String>,
    pub(super) stand_in: Option<StandIn>,
    /// Whether included files are not there.
    pub(super) files: bool,
}

/// A plain probe in the place of a plugin's.
#[derive(Clone, Debug)]
pub(super) struct StandIn {
    /// The plugin's section.
    pub(super) section: String,
    /// The offsets from the nozzle along x, y and z.
    pub(super) offsets_mm: [f64; 3],
}

impl StandIn {
    /// Its section of printer.cfg.
    pub(super) fn text(&self) -> String {
        let [x, y, z] = self.offsets_mm;
        format!("[probe]\npin: {PIN}\nx_offset: {x}\ny_offset: {y}\nz_offset: {z}")
    }
}

impl LeftOut {
    /// The sections and options that klippy's copy has to be without. `klipper` is the checkout, if it is known.
    ///
    /// # Errors
    ///
    /// The offsets of a plugin's probe are no numbers.
    pub(super) fn of(config: &Config, klipper: Option<&Path>) -> Result<LeftOut, Trouble> {
        // A misspelled section is no plugin's: klippy refuses it.
        let is_plugins = |section: &Section| lacks_module(section.kind(), klipper) && near(section.kind()).is_none();
        let all = config.sections();
        let is_without_pin = |section: &Section| section.text("pin").is_none() && section.name == "probe";
        let makes_probe = |kind: &str| kind == "probe" || MAKES_PROBE.contains(&kind);
        let has_own_probe = all.iter().any(|section| makes_probe(section.kind()) && !is_without_pin(section));
        let of_plugins =
            |is_it: &dyn Fn(&Section) -> bool| all.iter().find(|section| is_plugins(section) && is_it(section));
        let has_offset = |section: &Section| ["x_offset", "y_offset"].iter().any(|key| section.text(key).is_some());
        let probe = of_plugins(&|section| PROBES.contains(&section.kind())).or_else(|| of_plugins(&has_offset));
        let probe = probe.filter(|_| !has_own_probe);
        let has_plugin = all.iter().any(is_plugins);
        let has_known_sensor =
            |section: &Section| section.text("sensor_type").is_none_or(|named| is_known(config, named));
        let sources = klipper.filter(|_| has_plugin).map(sources).unwrap_or_default();
        let is_out = |section: &&Section| {
            let kind = section.kind();
            let motor = motor_of(section);
            let is_of_none =
                |motor: &str| config.section(motor).is_none_or(|motor| is_plugins(motor) || !is_axis(motor.kind()));
            let renames = || {
                section.text("rename_existing").is_some()
                    && !has_command(&sources, section.own_name().unwrap_or_default())
            };
            is_plugins(section)
                || !is_axis(kind)
                || kind.starts_with("tmc") && is_of_none(motor)
                // SAVE_CONFIG leaves the offset of a plugin's probe there.
                || is_without_pin(section) && probe.is_some()
                || kind == "gcode_macro" && !sources.is_empty() && renames()
                // A plugin may have the sensor. A heater needs it, so it stays, and klippy says so.
                || kind == "temperature_sensor" && has_plugin && !has_known_sensor(section)
        };
        let mut sections: Vec<String> = all.iter().filter(is_out).map(|section| section.name.clone()).collect();
        loop {
            let hangs = |section: &&Section| !sections.contains(&section.name) && hangs_on(config, section, &sections);
            let more: Vec<String> = all.iter().filter(hangs).map(|section| section.name.clone()).collect();
            if more.is_empty() {
                break;
            }
            sections.extend(more);
        }
        let saved = config.section("probe");
        let stand_in = |section: &Section| {
            let offset = |key: &str, usual: f64| {
                let own = section.number(key, Limit::Any)?;
                let saved = saved.map(|saved| saved.number(key, Limit::Any)).transpose()?.flatten();
                Ok::<f64, Trouble>(own.or(saved).unwrap_or(usual))
            };
            // Some measure how far they are from the bed, and have no height of their own.
            let own_mm = Some(offset("z_offset", 0.0)?).filter(|mm| *mm > 0.0);
            // Such a probe may go from point to point near the bed.
            let low_mm = all.iter().filter_map(|section| section.text("horizontal_move_z")?.trim().parse::<f64>().ok());
            let z_mm = own_mm.unwrap_or_else(|| low_mm.map(|mm| mm / 4.0).fold(Z_OFFSET_MM, f64::min));
            let offsets_mm = [offset("x_offset", 0.0)?, offset("y_offset", 0.0)?, z_mm];
            Ok::<StandIn, Trouble>(StandIn { section: section.name.clone(), offsets_mm })
        };
        Ok(LeftOut { sections, stand_in: probe.map(stand_in).transpose()?, files: false })
    }
}

/// Whether klippy cannot use a section without the ones that are left out: it measures with their chip, has a pin of
/// theirs, or is a macro in the place of a command and asks for their status. The printer itself stays.
fn hangs_on(config: &Config, section: &Section, left_out: &[String]) -> bool {
    let measures = || {
        ["accel_chip", "accel_chip_x", "accel_chip_y"]
            .iter()
            .filter_map(|key| section.text(key))
            .any(|chip| left_out.iter().any(|name| name == chip))
    };
    let is_gone = |chip: &str| {
        let names =
            |name: &String| name.split_once(' ').map_or(name == chip, |(kind, own)| kind == chip || own == chip);
        config.section(&format!("mcu {chip}")).is_none() && left_out.iter().any(names)
    };
    let has_pin = || {
        section.settings().iter().filter(|setting| setting.key.ends_with("pin")).any(|setting| {
            let pin = setting.value.trim_start_matches(['^', '~', '!', ' ']);
            pin.split_once(':').is_some_and(|(chip, _)| is_gone(chip.trim()))
        })
    };
    let is_printers = section.kind().starts_with("stepper") || section.kind().starts_with("extruder");
    // A macro in the place of a command. Without the macro the command still does its work.
    let asks = || {
        let asks_for = |name: &String| {
            let word = format!("printer.{name}");
            let text = section.text("gcode").unwrap_or_default();
            let ends =
                |at: usize| !text[at + word.len()..].starts_with(|next: char| next.is_alphanumeric() || next == '_');
            text.match_indices(&word).any(|(at, _)| ends(at))
        };
        section.text("rename_existing").is_some() && left_out.iter().any(asks_for)
    };
    measures() || asks() || !is_printers && section.kind() != "heater_bed" && has_pin()
}

/// The sections that klippy needs from an included file that is missing.
pub(super) fn stand_in(path: &Path) -> &'static str {
    let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
    if ["mainsail.cfg", "fluidd.cfg", "client.cfg"].contains(&name) { OF_INTERFACE } else { "" }
}

/// Whether this is no stepper, or one of klippy's kinematics. A plugin may have others: `[stepper_mmu_gear]`.
fn is_axis(kind: &str) -> bool {
    let Some(axis) = kind.strip_prefix("stepper_") else { return true };
    STEPPERS.iter().any(|own| is_numbered(axis, own)) || axis.len() == 1
}

/// klippy's sources.
fn sources(klipper: &Path) -> Vec<String> {
    let klippy = klipper.join("klippy");
    let names = |folder: &Path| -> Vec<PathBuf> {
        fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path()).collect()
    };
    let within = ["extras", "kinematics", "plugins"].iter().flat_map(|folder| names(&klippy.join(folder)));
    let files = names(&klippy).into_iter().chain(within).filter(|path| path.extension().is_some_and(|end| end == "py"));
    let text = |path: PathBuf| Some(String::from_utf8_lossy(&foreign::read(&path, SOURCE_MAX).ok()?).into_owned());
    files.filter_map(text).collect()
}

/// Whether klippy has this command.
fn has_command(sources: &[String], command: &str) -> bool {
    let command = command.to_uppercase();
    let forms = [format!("\"{command}\""), format!("'{command}'"), format!("cmd_{command}")];
    sources.iter().any(|source| forms.iter().any(|form| source.contains(form)))
}

#[cfg(test)]
mod tests {
    use super::*;

    const SAVED: &str = "\n#*# <---------------------- SAVE_CONFIG ---------------------->\n\
                         #*# DO NOT EDIT THIS BLOCK OR BELOW. The contents are auto-generated.\n#*#\n";

    fn left_out(text: &str, klipper: Option<&Path>) -> (Vec<String>, Option<StandIn>) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("printer.cfg");
        fs::write(&path, text).unwrap();
        let LeftOut { sections, stand_in, .. } = LeftOut::of(&Config::read(&path).unwrap(), klipper).unwrap();
        (sections, stand_in)
    }

    #[test]
    fn a_plain_probe_takes_the_place_of_a_plugin_s() {
        for kind in PROBES {
            let text =
                format!("[{kind}]\ny_offset: 20\n[bed_mesh]\nmesh_min: 1, 1\n{SAVED}#*# [probe]\n#*# z_offset = 1.2\n");
            let (sections, stand_in) = left_out(&text, None);
            let stand_in = stand_in.unwrap();
            assert_eq!(sections, [kind, "probe"]);
            assert_eq!((stand_in.section.as_str(), stand_in.offsets_mm), (kind, [0.0, 20.0, 1.2]));
            assert_eq!(stand_in.text(), "[probe]\npin: pinion_stand_in\nx_offset: 0\ny_offset: 20\nz_offset: 1.2");
        }
        let (_, stand_in) = left_out("[shaketune]\n[BDsensor]\nz_offset: 0\ny_offset: 25\n", None);
        assert_eq!(stand_in.unwrap().offsets_mm, [0.0, 25.0, Z_OFFSET_MM], "one that is not in the list");
        let (_, stand_in) = left_out("[beacon]\ny_offset: 25\n[bed_mesh]\nhorizontal_move_z: 1\n", None);
        assert_eq!(stand_in.unwrap().offsets_mm, [0.0, 25.0, 0.25], "it goes near the bed");
        let (sections, stand_in) = left_out("[beacon]\nserial: x\n[probe]\npin: PA1\nz_offset: 1\n", None);
        assert_eq!((sections, stand_in.is_none()), (vec!["beacon".to_owned()], true), "it has one");
    }

    #[test]
    fn what_hangs_on_a_plugin_goes_with_it() {
        let text = "[mmu_machine]\n[stepper_mmu_gear]\nstep_pin: PD0\n[tmc2209 stepper_mmu_gear]\nuart_pin: PD4\n\
                    [AFC_stepper lane1]\nstep_pin: PD1\n[tmc2209 AFC_stepper lane1]\nuart_pin: PD5\n[stepper_z1]\n\
                    step_pin: PE1\n[tmc2209 stepper_z1]\nuart_pin: PE2\n[temperature_sensor a]\nsensor_type: AHT2X_TCA\n\
                    [temperature_sensor b]\nsensor_type: AHT2X\n";
        let expected = [
            "mmu_machine",
            "stepper_mmu_gear",
            "tmc2209 stepper_mmu_gear",
            "AFC_stepper lane1",
            "tmc2209 AFC_stepper lane1",
            "temperature_sensor a",
        ];
        assert_eq!(left_out(text, None).0, expected);
    }

    #[test]
    fn what_measures_with_a_plugin_or_has_its_pins_goes_too() {
        let text = "[beacon]\nserial: x\n[adxl345]\ncs_pin: beacon:PA3\n[resonance_tester]\naccel_chip: adxl345\n\
                    [adxl345 bed]\ncs_pin: bed:PA3\n[mcu bed]\nserial: y\n[stepper_x]\nendstop_pin: beacon:PA1\n";
        assert_eq!(left_out(text, None).0, ["beacon", "adxl345", "resonance_tester"]);
    }

    #[test]
    fn a_command_loses_the_macro_in_its_place_that_asks_for_a_plugin_s_status() {
        let text = "[toolchanger]\n[gcode_macro M104]\nrename_existing: M104.1\ngcode: {printer.toolchanger.tool}\n\
                    [gcode_macro M109]\nrename_existing: M109.1\ngcode: {printer.toolchanger_led}\n\
                    [gcode_macro TOOL]\ngcode: {printer.toolchanger.tool}\n";
        assert_eq!(left_out(text, None).0, ["toolchanger", "gcode_macro M104"]);
    }

    #[test]
    fn a_misspelled_section_stays() {
        assert_eq!(left_out("[heater_fann hotend]\npin: PA1\n[shaketune]\n", None).0, ["shaketune"]);
    }

    #[test]
    fn a_macro_that_renames_a_command_of_a_plugin_goes_too() {
        let klipper = tempfile::tempdir().unwrap();
        let extras = klipper.path().join("klippy/extras");
        fs::create_dir_all(&extras).unwrap();
        fs::write(extras.join("gcode_macro.py"), "").unwrap();
        fs::write(extras.join("homing.py"), "gcode.register_command('G28', self.cmd_G28)\n").unwrap();
        let text = "[z_calib_plugin]\n[gcode_macro CALIBRATE_Z]\nrename_existing: BASE_Z\ngcode: BASE_Z\n\
                    [gcode_macro G28]\nrename_existing: G28.1\ngcode: G28.1\n[gcode_macro X]\ngcode: G28\n";
        assert_eq!(left_out(text, Some(klipper.path())).0, ["z_calib_plugin", "gcode_macro CALIBRATE_Z"]);
        assert_eq!(left_out(text, None).0, ["z_calib_plugin"], "nobody knows the commands");
    }
}
