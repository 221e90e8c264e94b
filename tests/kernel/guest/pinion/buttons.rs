// SPDX-License-Identifier: GPL-3.0-or-later
//! Buttons with lines that are claimed after `finalize_config`.

use std::time::{Duration, Instant};

use nix::errno::Errno;
use pinion_client::Client;

use crate::gpio_sim::GpioSim;
use crate::program::{Program, configure, run};
use crate::uapi;

fn state(client: &mut Client) -> Vec<u8> {
    let until = Instant::now() + Duration::from_secs(10);
    let state = client.wait("buttons_state", Some(0), until).expect("a session").expect("a state");
    run(client, "buttons_ack oid=0 count=1");
    state.bytes("state").expect("a state").to_vec()
}

#[test]
fn buttons_are_added_after_the_configuration_and_once_more_after_a_restart() {
    add_twice(&Program::start());
}

fn add_twice(program: &Program) {
    let sim = GpioSim::new("lab", 8);
    let client = &mut program.connect();
    configure(client, 1, &["config_buttons oid=0 button_count=2"]);
    for _ in 0..2 {
        for place in [0, 1] {
            run(client, &format!("buttons_add oid=0 pos={place} pin=lab/gpio{} pull_up=0", place + 3));
        }
        let at = client.clock_in(0.05).expect("the clock").wire();
        run(client, &format!("buttons_query oid=0 clock={at} rest_ticks=100000 retransmit_count=50 invert=0"));
        for (offset, up, pressed) in [(3, true, 1), (4, true, 3), (3, false, 2), (4, false, 0)] {
            sim.pull(offset, up);
            assert_eq!(state(client), [pressed]);
        }
    }
}

/// `make test-slow` has it.
mod slow {
    use super::*;

    #[test]
    fn buttons_are_added_once_more_on_linux_before_5_5() {
        for errno in [Errno::EINVAL, Errno::ENOTTY] {
            add_twice(&Program::without_ioctl(uapi::GPIOHANDLE_SET_CONFIG, errno));
        }
    }
}
