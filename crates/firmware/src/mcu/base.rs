// SPDX-License-Identifier: GPL-3.0-or-later
//! The commands that every MCU has: identify, clock, configuration, shutdown, debugging.

use crate::shutdown::{Shutdown, reason};
use crate::time::{CLOCK_FREQ, Clock};

use super::stats::SUMSQ_BASE;
use super::{Command, Constant, Enumeration, Feature, Form, Hosts, Response, command, response};

/// This file's entries in the dictionary.
pub const FEATURE: Feature = Feature {
    serves: "every printer",
    commands: &[
        IDENTIFY,
        GET_CLOCK,
        GET_UPTIME,
        GET_CONFIG,
        ALLOCATE_OIDS,
        FINALIZE_CONFIG,
        CONFIG_RESET,
        EMERGENCY_STOP,
        CLEAR_SHUTDOWN,
        DEBUG_NOP,
        DEBUG_PING,
        DEBUG_READ,
        DEBUG_WRITE,
    ],
    responses: RESPONSES,
    constants: &[
        Constant::number("CLOCK_FREQ", CLOCK_FREQ),
        Constant::text("MCU", "linux"),
        Constant::number("RECEIVE_WINDOW", RECEIVE_WINDOW_BYTES),
        Constant::number("STATS_SUMSQ_BASE", SUMSQ_BASE),
    ],
    enumerations: &[Enumeration::new("pin", |board| board.pins())],
    shutdowns: reason::SHUTDOWNS,
    ..Feature::EMPTY
};

const RESPONSES: &[Form] = &[
    IdentifyResponse::FORM,
    ClockResponse::FORM,
    Uptime::FORM,
    ConfigOfV010::FORM,
    Config::FORM,
    Starting::FORM,
    ShutdownReport::FORM,
    IsShutdown::FORM,
    Stats::FORM,
    Pong::FORM,
    // Never sent, because `debug_read` is refused. Klipper's dictionary has it.
    Form { format: "debug_result val=%u", hosts: Hosts::ALL },
];

/// How many bytes the host may send before an acknowledgement. It is half of a pty's buffer of 4096 bytes. So the
/// buffer has room for them, and the host never blocks in its write.
const RECEIVE_WINDOW_BYTES: u32 = 2048;

/// Whether the response at this place in the list of all responses is the MCU's own.
pub(super) const fn is_own_response(index: usize) -> bool {
    index < RESPONSES.len()
}

response! {
    /// A piece of the compressed dictionary.
    "identify_response offset=%u data=%.*s"
    pub struct IdentifyResponse<'a> { offset: u32, data: &'a [u8] }
}
response! {
    /// The time now.
    "clock clock=%u"
    pub struct ClockResponse { clock: Clock }
}

impl From<Clock> for ClockResponse {
    fn from(clock: Clock) -> ClockResponse {
        ClockResponse { clock }
    }
}

response! {
    /// The time now, in 64 bits.
    "uptime high=%u clock=%u"
    pub struct Uptime { high: u32, clock: Clock }
}

impl From<Clock> for Uptime {
    fn from(clock: Clock) -> Uptime {
        Uptime { high: (clock.ticks() >> 32) as u32, clock }
    }
}

response! {
    /// Whether the MCU is configured, and the checksum of that configuration, as the host gave it.
    "config is_config=%c crc=%u is_shutdown=%c move_count=%hu"
    pub struct Config { is_config: bool, crc: u32, is_shutdown: bool, move_count: u16 }
}

response! {
    /// The same in the order of hosts before November 2021.
    "config is_config=%c crc=%u move_count=%hu is_shutdown=%c" => Hosts::of(&[]);
    pub struct ConfigOfV010 { is_config: bool, crc: u32, move_count: u16, is_shutdown: bool }
}

impl From<Config> for ConfigOfV010 {
    fn from(Config { is_config, crc, is_shutdown, move_count }: Config) -> ConfigOfV010 {
        ConfigOfV010 { is_config, crc, move_count, is_shutdown }
    }
}

impl Config {
    const KNOWN: u64 = 1 << 63;
    const IS_CONFIG: u64 = 1 << 62;
    const IS_SHUTDOWN: u64 = 1 << 61;

    /// The answer as a word that is not 0.
    pub fn word(&self) -> u64 {
        let flag = |is_set, bit| if is_set { bit } else { 0 };
        let flags = Self::KNOWN | flag(self.is_config, Self::IS_CONFIG) | flag(self.is_shutdown, Self::IS_SHUTDOWN);
        flags | u64::from(self.move_count) << 32 | u64::from(self.crc)
    }

    /// The answer from which [`Config::word`] made this word.
    pub fn of_word(word: u64) -> Option<Config> {
        (word & Self::KNOWN != 0).then_some(Config {
            is_config: word & Self::IS_CONFIG != 0,
            crc: word as u32,
            is_shutdown: word & Self::IS_SHUTDOWN != 0,
            move_count: (word >> 32) as u16,
        })
    }
}

response! {
    /// The MCU has started and waits for its configuration.
    "starting"
    pub struct Starting {}
}
response! {
    /// The MCU has stopped.
    "shutdown clock=%u static_string_id=%hu"
    pub(super) struct ShutdownReport { clock: Clock, static_string_id: u16 }
}
response! {
    /// A command was not run, because the MCU is stopped.
    "is_shutdown static_string_id=%hu"
    pub(super) struct IsShutdown { static_string_id: u16 }
}
response! {
    /// How busy the core was.
    "stats count=%u sum=%u sumsq=%u"
    pub struct Stats { count: u32, sum: u32, sumsq: u32 }
}
response! {
    /// The answer to `debug_ping`.
    "pong data=%*s"
    pub(super) struct Pong<'a> { data: &'a [u8] }
}

/// The answer to `identify`: at most `count` bytes of the compressed dictionary, from `offset` on. It has fewer if the
/// dictionary ends or the block is full.
pub fn identify_response(dictionary: &[u8], offset: u32, count: u8) -> IdentifyResponse<'_> {
    // The payload also has the id (1 byte), the offset (up to 5) and the length (1).
    let count = usize::from(count).min(pinion_protocol::block::PAYLOAD_MAX - 7);
    let start = (offset as usize).min(dictionary.len());
    let end = (start + count).min(dictionary.len());
    IdentifyResponse { offset, data: &dictionary[start..end] }
}

const IDENTIFY: Command = command!("identify offset=%u count=%c", |mcu: &mut Mcu, offset: u32, count: u8| {
    let dialect = mcu.heard().clone();
    mcu.state.wire.send(identify_response(dialect.compressed(), offset, count));
    Ok(())
})
.allowed_in_shutdown();

const GET_CLOCK: Command = command!("get_clock", |mcu: &mut Mcu| {
    let clock = mcu.now();
    mcu.state.wire.send(ClockResponse { clock });
    Ok(())
})
.allowed_in_shutdown();

const GET_UPTIME: Command = command!("get_uptime", |mcu: &mut Mcu| {
    let uptime = Uptime::from(mcu.now());
    mcu.state.wire.send(uptime);
    Ok(())
})
.allowed_in_shutdown();

const GET_CONFIG: Command = command!("get_config", |mcu: &mut Mcu| {
    mcu.state.wire.send(mcu.config());
    // The dictionary has one of both.
    mcu.state.wire.send(ConfigOfV010::from(mcu.config()));
    Ok(())
})
.allowed_in_shutdown();

const ALLOCATE_OIDS: Command = command!("allocate_oids count=%c", |mcu: &mut Mcu, count: u8| mcu.allocate_oids(count));

const FINALIZE_CONFIG: Command = command!("finalize_config crc=%u", |mcu: &mut Mcu, crc: u32| mcu.finalize(crc));

const CONFIG_RESET: Command = command!("config_reset", |mcu: &mut Mcu| mcu.reset()).allowed_in_shutdown();

pub(super) const EMERGENCY_STOP: Command =
    command!("emergency_stop", |_mcu: &mut Mcu| Err(emergency())).allowed_in_shutdown();

/// The shutdown that `emergency_stop` causes.
pub fn emergency() -> Shutdown {
    Shutdown::because(reason::COMMAND_REQUEST, "the host asked for it (FIRMWARE_RESTART, M112 or an error)")
        .remedy("see klippy.log for the cause, then FIRMWARE_RESTART")
}

const CLEAR_SHUTDOWN: Command = command!("clear_shutdown", |mcu: &mut Mcu| mcu.clear_shutdown()).allowed_in_shutdown();

const DEBUG_NOP: Command = command!("debug_nop", |_mcu: &mut Mcu| Ok(())).allowed_in_shutdown();

const DEBUG_PING: Command = command!("debug_ping data=%*s", |mcu: &mut Mcu, data: &[u8]| {
    mcu.state.wire.send(Pong { data });
    Ok(())
})
.allowed_in_shutdown();

const DEBUG_READ: Command = command!("debug_read order=%c addr=%u", |_mcu: &mut Mcu, order: u8, addr: u32| {
    let _ = (order, addr);
    Err(debug_refused("debug_read"))
})
.allowed_in_shutdown();

const DEBUG_WRITE: Command =
    command!("debug_write order=%c addr=%u val=%u", |_mcu: &mut Mcu, order: u8, addr: u32, val: u32| {
        let _ = (order, addr, val);
        Err(debug_refused("debug_write"))
    })
    .allowed_in_shutdown();

fn debug_refused(command: &str) -> Shutdown {
    let cause = format!("the host sent {command}: a process of Linux does not poke memory for a host");
    Shutdown::because(reason::DEBUG_MEMORY, cause).remedy("remove the command")
}
