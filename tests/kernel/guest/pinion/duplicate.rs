// SPDX-License-Identifier: GPL-3.0-or-later
//! Several uses of one line, which `[duplicate_pin_override]` in printer.cfg allows.

use std::fs;
use std::os::unix::fs::symlink;
use std::path::PathBuf;

use pinion_client::Client;

use crate::gpio_sim::GpioSim;
use crate::program::{Program, configure, exists, refusal, run};
use crate::sysfs;
use crate::trace::Trace;
use crate::uapi;

fn output(oid: usize, pin: &str, default: u8) -> String {
    format!("config_digital_out oid={oid} pin={pin} value={default} default_value={default} max_duration=0")
}

fn input(oid: usize, pin: &str) -> String {
    format!("config_endstop oid={oid} pin={pin} pull_up=0")
}

fn set(client: &mut Client, oid: u8, value: u8) {
    run(client, &format!("update_digital_out oid={oid} value={value}"));
}

fn sees_high(client: &mut Client, oid: u8) -> bool {
    let args = [("oid", oid.into())];
    let state = client.query("endstop_query_state", &args, "endstop_state", Some(oid)).expect("a state");
    state.flag("pin_value").expect("a level")
}

/// Kills the program, waits for its guardian to finish, and returns the log.
fn kill(mut program: Program) -> String {
    let guardian = program.guardian();
    program.kill();
    sysfs::wait_until("the guardian ends", || !exists(guardian));
    program.log()
}

/// Another node of a chip. It is removed when dropped.
struct Alias(PathBuf);

impl Alias {
    const CHIP: u32 = 7;

    fn of(sim: &GpioSim) -> Alias {
        let path = PathBuf::from(format!("/dev/gpiochip{}", Alias::CHIP));
        // Relative, as udev makes it.
        symlink(sim.chip_name(), &path).expect("a link");
        Alias(path)
    }

    /// The number of a line at this node. The line has no name.
    fn pin(offset: u32) -> String {
        (Alias::CHIP * 288 + offset).to_string()
    }
}

impl Drop for Alias {
    fn drop(&mut self) {
        let _ = fs::remove_file(&self.0);
    }
}

#[test]
fn two_nodes_of_one_chip_are_one_chip() {
    let sim = GpioSim::new("lab", 8);
    let _alias = Alias::of(&sim);
    let program = Program::start();
    let client = &mut program.connect();
    configure(client, 2, &[output(0, "lab/gpio1", 0), output(1, &Alias::pin(1), 0)]);
    for (oid, value) in [(0, 1), (1, 0), (1, 1), (0, 0)] {
        set(client, oid, value);
        assert_eq!(sim.level(1), value == 1);
    }
}

/// `make test-slow` has them.
mod slow {
    use super::*;

    #[test]
    fn a_line_of_another_user_is_refused_all_the_same() {
        let sim = GpioSim::builder("lab", 8).hog(6, "spi0 CS1").build();
        let program = Program::start();
        let client = &mut program.connect();
        let uses = [output(0, "lab/gpio6", 0), output(1, "lab/gpio6", 0)];
        assert_eq!(refusal(client, 2, &uses), "Unable to open out GPIO chip line");
        program.wait_for_line(&["line 6", "in use by \"spi0 CS1\""]);
        assert_eq!(uapi::line_info(&sim.path(), 6).consumer, "spi0 CS1");
    }

    #[test]
    fn two_outputs_drive_one_line_by_turns_and_the_guardian_knows_the_last_shutdown_value() {
        let sim = GpioSim::builder("lab", 8).name(1, "FAN").build();
        let line = sim.kernel_number(1);
        for (defaults, last) in [([0, 1], true), ([1, 0], false)] {
            let program = Program::start();
            let client = &mut program.connect();
            configure(client, 2, &[output(0, "FAN", defaults[0]), output(1, "lab/gpio1", defaults[1])]);
            assert_eq!(sim.level(1), last);
            for (oid, value) in [(0, 1), (1, 0), (1, 1), (0, 0), (0, u8::from(!last))] {
                set(client, oid, value);
                assert_eq!(sim.level(1), value == 1);
            }
            // A stop, and then all of it again.
            client.reset().expect("a reset");
            configure(client, 2, &[output(0, "FAN", defaults[0]), output(1, "lab/gpio1", defaults[1])]);
            set(client, 1, u8::from(!last));
            let trace = Trace::start();
            let log = kill(program);
            assert!(log.contains("all 1 outputs are driven"), "{log}");
            let writes: Vec<bool> = trace.writes_to(line).iter().map(|write| write.level).collect();
            assert!(!writes.is_empty() && writes.iter().all(|level| *level == last), "{writes:?}");
        }
    }

    #[test]
    fn of_an_output_and_an_input_the_last_one_decides() {
        let sim = GpioSim::new("lab", 8);
        let line = sim.kernel_number(1);
        let program = Program::start();
        let client = &mut program.connect();
        configure(client, 2, &[output(0, "lab/gpio1", 1), input(1, "lab/gpio1")]);
        for up in [true, false] {
            sim.pull(1, up);
            for value in [1, 0] {
                set(client, 0, value);
                assert_eq!(sees_high(client, 1), up, "the output does nothing");
            }
        }
        client.reset().expect("a reset");
        configure(client, 2, &[input(0, "lab/gpio1"), output(1, "lab/gpio1", 0)]);
        sim.pull(1, false);
        for value in [1, 0] {
            set(client, 1, value);
            assert_eq!(sees_high(client, 0), value == 1, "it sees what is driven");
        }
        client.reset().expect("a reset");
        configure(client, 2, &[output(0, "lab/gpio1", 1), input(1, "lab/gpio1")]);
        let trace = Trace::start();
        let log = kill(program);
        assert_eq!(trace.writes_to(line), []);
        assert!(!log.contains("guardian"), "an input is none of its business: {log}");
    }
}
