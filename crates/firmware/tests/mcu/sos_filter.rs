// SPDX-License-Identifier: GPL-3.0-or-later
//! The commands that a host may send to a filter. The filter's own file tests its arithmetic, and `trigger_analog.rs`
//! its results.

use pinion_testbench::rig::Rig;

const REFUSED: &str = "Filter section index larger than max_sections";

fn rig() -> Rig {
    Rig::configured(&["config_sos_filter oid=0 max_sections=2", "config_sos_filter oid=1 max_sections=0"])
}

#[test]
fn sections_up_to_the_last_may_be_set() {
    let mut rig = rig();
    rig.send_all(&[
        "sos_filter_set_section oid=0 section_idx=1 sos0=-2147483648 sos1=2147483647 sos2=0 sos3=1 sos4=-1",
        "sos_filter_set_state oid=0 section_idx=1 state0=-2147483648 state1=2147483647",
        "sos_filter_set_offset_scale oid=0 offset=-1 scale=-1 scale_frac_bits=255 auto_offset=1",
        "sos_filter_set_active oid=0 n_sections=2 coeff_frac_bits=255",
        "sos_filter_set_active oid=1 n_sections=0 coeff_frac_bits=0",
    ]);
    assert_eq!(rig.responses(), [""; 0]);
}

#[test]
fn a_section_beyond_the_last_is_refused() {
    for command in [
        "sos_filter_set_section oid=0 section_idx=2 sos0=0 sos1=0 sos2=0 sos3=0 sos4=0",
        "sos_filter_set_section oid=1 section_idx=0 sos0=0 sos1=0 sos2=0 sos3=0 sos4=0",
        "sos_filter_set_state oid=0 section_idx=255 state0=0 state1=0",
        "sos_filter_set_active oid=0 n_sections=3 coeff_frac_bits=0",
        "sos_filter_set_active oid=1 n_sections=1 coeff_frac_bits=0",
    ] {
        let mut rig = rig();
        rig.send(command);
        assert_eq!(rig.shutdown().as_deref(), Some(REFUSED), "{command}");
        let note = rig.notes().pop().unwrap();
        assert!(note.contains("SOS filter oid") && note.contains("FIRMWARE_RESTART"), "{note}");
    }
}
