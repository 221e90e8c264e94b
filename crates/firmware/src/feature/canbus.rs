// SPDX-License-Identifier: GPL-3.0-or-later
//! Commands of a host on a CAN bus: the node's identity and the health of the bus (Klipper's canserial.c).

use crate::board::Range;
use crate::mcu::{
    CanHealth, CanNode, CanState, Command, Context, Enumeration, Feature, Response, Wire, command, response,
};
use crate::shutdown::shutdowns;

pub(super) const FEATURE: Feature = Feature {
    serves: "CAN bus",

    commands: &[GET_CANBUS_ID, GET_CANBUS_STATUS],
    responses: &[CanbusId::FORM, CanbusStatus::FORM],
    enumerations: &[Enumeration::new("canbus_bus_state", |_board| states())],
    shutdowns: SHUTDOWNS,
    is_on: |wire| matches!(wire, Wire::Can(_)),
    ..Feature::EMPTY
};

shutdowns! {
    /// Another node sends with this node's CAN ids.
    pub ID_CONFLICT = "Another CAN node assigned this ID";
}

response! {
    /// The node's UUID, and the nodeid that the host has assigned, or 0.
    "canbus_id canbus_uuid=%.*s canbus_nodeid=%u"
    pub(super) struct CanbusId<'a> { canbus_uuid: &'a [u8], canbus_nodeid: u32 }
}
response! {
    /// The health of the bus.
    "canbus_status rx_error=%u tx_error=%u tx_retries=%u canbus_bus_state=%u"
    pub(super) struct CanbusStatus { rx_error: u32, tx_error: u32, tx_retries: u32, canbus_bus_state: u32 }
}

fn states() -> Vec<Range> {
    let range = |(state, name): (CanState, &str)| Range { name: name.into(), first: state as u32, count: 1 };
    CanState::ALL.map(range).into()
}

/// Calls `f` with the node. A host on another wire does not know these commands.
fn with_node(context: &mut Context, f: impl FnOnce(&mut Context, &CanNode)) {
    let dialect = context.heard().clone();
    if let Wire::Can(node) = dialect.wire() {
        f(context, node);
    }
}

const GET_CANBUS_ID: Command = command!("get_canbus_id", |context| {
    with_node(context, |context, node| {
        context.send(CanbusId { canbus_uuid: &node.uuid, canbus_nodeid: node.node_id().into() });
    });
    Ok(())
})
.allowed_in_shutdown();

const GET_CANBUS_STATUS: Command = command!("get_canbus_status", |context| {
    with_node(context, |context, node| {
        let CanHealth { rx_error, tx_error, tx_retries, state } = node.health();
        context.send(CanbusStatus { rx_error, tx_error, tx_retries, canbus_bus_state: state as u32 });
    });
    Ok(())
})
.allowed_in_shutdown();
