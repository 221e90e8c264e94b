// SPDX-License-Identifier: GPL-3.0-or-later
//! Constants and responses about the wire.

use std::sync::Arc;

use pinion_firmware::mcu::{CanHealth, CanNode, CanState, Dialect, DialectName, Firmware, Wire};
use pinion_firmware::time::{Clock, VirtualClock};
use pinion_testbench::board::{Bench, FakeBoard};
use pinion_testbench::rig::{FIRMWARE, Rig};

fn dialect(wire: Wire) -> Dialect {
    let board = FakeBoard(Bench::new(VirtualClock::at(Clock::EPOCH), Clock::EPOCH));
    Dialect::new(&Firmware { wire, ..FIRMWARE }, &board, DialectName::Master).unwrap()
}

#[test]
fn only_a_host_on_a_can_bus_has_its_commands() {
    let node = Arc::new(CanNode::new([1, 2, 3, 4, 5, 6], Some(500_000)));
    let (terminal, serial, can) = (dialect(Wire::Terminal), dialect(Wire::Serial(115_200)), dialect(Wire::Can(node)));
    for command in ["get_canbus_id", "get_canbus_status"] {
        assert!(can.command_id(command).is_some());
        assert!(terminal.command_id(command).is_none() && serial.command_id(command).is_none());
    }
    let number = |dialect: &Dialect, name: &str| dialect.dictionary().config.get(name).and_then(|value| value.as_u64());
    assert_eq!((number(&can, "CANBUS_FREQUENCY"), number(&can, "SERIAL_BAUD")), (Some(500_000), None));
    assert_eq!((number(&serial, "CANBUS_FREQUENCY"), number(&serial, "SERIAL_BAUD")), (None, Some(115_200)));
    assert_eq!((number(&terminal, "CANBUS_FREQUENCY"), number(&terminal, "SERIAL_BAUD")), (None, None));
    assert!(can.dictionary().enumerations.contains_key("canbus_bus_state"));
    assert!(!terminal.dictionary().enumerations.contains_key("canbus_bus_state"));
    // The other messages have the same ids, so that nothing else depends on the wire.
    assert_eq!(can.command_id("emergency_stop"), terminal.command_id("emergency_stop"));
}

#[test]
fn a_node_reports_its_identity_and_the_health_of_the_bus() {
    let node = Arc::new(CanNode::new([0xa, 0xb, 0xc, 0xd, 0xe, 0xf], None));
    let mut rig = Rig::with_dialect(Arc::new(dialect(Wire::Can(node.clone()))));
    node.assign(4);
    let health = CanHealth { rx_error: 1, tx_error: 130, tx_retries: 7, state: CanState::Passive };
    node.report(health);
    assert_eq!(node.health(), health);
    assert_eq!(rig.ask("get_canbus_id"), "canbus_id canbus_uuid=0a0b0c0d0e0f canbus_nodeid=4");
    let status = "canbus_status rx_error=1 tx_error=130 tx_retries=7 canbus_bus_state=2";
    assert_eq!(rig.ask("get_canbus_status"), status);
}
