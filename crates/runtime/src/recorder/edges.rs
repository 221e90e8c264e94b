// SPDX-License-Identifier: GPL-3.0-or-later
//! Records the edges of outputs, if somebody asks for it.

use std::sync::{Arc, Mutex};

use pinion_firmware::board::Pin;
use pinion_firmware::mcu::EdgeRecorder;
use pinion_firmware::time::TimeSource;
use pinion_linux::clock::Monotonic;

use pinion_trace::event::Event;
use pinion_trace::file::Names;
use pinion_trace::ring::Writer;

use super::locked;

/// Where the edges are recorded. Core and workers write lines.
pub(super) struct EdgeWriter {
    pub(super) writer: Mutex<Writer>,
    pub(super) clock: Monotonic,
    /// Where the names of the lines are noted.
    pub(super) names: Arc<Mutex<Names>>,
}

impl EdgeRecorder for EdgeWriter {
    fn claimed(&self, pin: Pin, name: String) {
        locked(&self.names).pins.insert(pin.0, name);
    }

    /// No thread waits for another one here. If two change lines at the same time, one edge is missing.
    fn edge(&self, pin: Pin, level: bool) {
        if let Ok(mut writer) = self.writer.try_lock() {
            writer.write(self.clock.now(), Event::Edge { pin: pin.0, level });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recorder::Recording;
    use pinion_testbench::rig::Rig;

    /// An MCU whose outputs are recorded, and the lines that it has named.
    fn recorded(recording: &Recording) -> (Rig, Arc<Mutex<Names>>) {
        let names = Arc::<Mutex<Names>>::default();
        let writer = Mutex::new(recording.memory.edges().unwrap());
        let mut rig = Rig::new();
        rig.mcu.record_edges(Arc::new(EdgeWriter { writer, clock: recording.clock, names: names.clone() }));
        (rig, names)
    }

    #[test]
    fn outputs_are_named_again_after_a_reset() {
        let (mut rig, names) = recorded(&Recording::of_a_test());
        let output = "config_digital_out oid=0 pin=3 value=1 default_value=0 max_duration=0";
        rig.configure(&[output, "config_counter oid=1 pin=30 pull_up=1"]);
        let lines: Vec<String> = names.lock().unwrap().pins.values().cloned().collect();
        assert_eq!(lines, ["gpio3"], "the kernel counts the edges of the other line");
        rig.send_all(&["emergency_stop", "config_reset"]);
        rig.responses();
        names.lock().unwrap().pins.clear();
        rig.configure(&[output]);
        assert_eq!(names.lock().unwrap().pins[&3], "gpio3");
    }

    #[test]
    fn each_change_of_an_output_is_recorded_once() {
        let recording = Recording::of_a_test();
        let (mut rig, _) = recorded(&recording);
        rig.configure(&["config_digital_out oid=0 pin=3 value=1 default_value=0 max_duration=0"]);
        for value in [1, 0, 0, 1] {
            rig.send(&format!("update_digital_out oid=0 value={value}"));
        }
        assert!(rig.bench.level(3));
        rig.send("emergency_stop");
        let events = recording.memory.rings().next().unwrap().newest();
        let levels: Vec<bool> = events
            .into_iter()
            .map(|words| match Event::decode(words) {
                Some((_, Event::Edge { pin: 3, level })) => level,
                other => panic!("{other:?}"),
            })
            .collect();
        assert_eq!(levels, [true, false, true, false]);
    }
}
