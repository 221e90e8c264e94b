// SPDX-License-Identifier: GPL-3.0-or-later
//! Chains of WS2812 LEDs ("neopixels"), on the data output (MOSI) of an SPI controller (`spi.rs`) or on a GPIO line that
//! is written through registers (`line.rs`).
//!
//! A data bit of the chain is a pulse: a short one is 0, a long one is 1. The chain takes its colors when the line has
//! been low for a while.

use crate::board::{Direction, Mosi, OnWorker, Pin};
use crate::mcu::{
    Back, Command, Context, DeviceId, DeviceWarning, Feature, Finished, Job, JobSlot, Object, Oid, Response, command,
    response,
};
use crate::shutdown::{Shutdown, reason, shutdowns};
use crate::time::Ticks;

use line::Pulses;
use spi::Waves;

mod line;
mod spi;

pub(super) const FEATURE: Feature = Feature {
    serves: "neopixels",

    commands: &[CONFIG_NEOPIXEL, NEOPIXEL_UPDATE, NEOPIXEL_SEND],
    responses: &[Sent::FORM],
    shutdowns: SHUTDOWNS,
    ..Feature::EMPTY
};

shutdowns! {
    /// The chain has more bytes than the format, the SPI driver or a line has room for.
    INVALID_SIZE = "Invalid neopixel data_size";
    /// `neopixel_update` past the end of the chain.
    INVALID_UPDATE = "Invalid neopixel update command";
}

response! {
    /// The colors are on their way to the LEDs, or could not be sent. klippy sends again after a failure.
    "neopixel_result oid=%c success=%c"
    pub(super) struct Sent { oid: Oid, success: bool }
}

/// Shortest time that the line is low before and after the colors. klippy asks for 50 us. Newer WS2812B need 280 us to
/// take their colors (Worldsemi WS2812B-V5, "Data transfer time": RES).
const RESET_MIN: Ticks = Ticks::from_us(300);
/// Lowest size and position that are refused, as in Klipper's C.
const SIZE_LIMIT: u16 = 0x8000;

/// The way to the LEDs.
enum Interface {
    Spi(Waves),
    Line(Pulses),
}

/// Sends the chain's colors.
struct Frame {
    data: Vec<u8>,
    warning: Option<DeviceWarning>,
}

impl Job for Frame {
    type Device = Interface;
    /// Whether the pulses had their times.
    type Out = bool;
    type Failure = Shutdown;

    fn run(&mut self, way: &mut Interface) -> Result<bool, Shutdown> {
        match way {
            Interface::Spi(waves) => waves.send(&self.data).map(|()| true),
            Interface::Line(pulses) => {
                let sent = pulses.send(&self.data);
                self.warning = pulses.warning.take();
                sent
            }
        }
    }

    fn take_warning(&mut self) -> Option<DeviceWarning> {
        self.warning.take()
    }
}

struct Neopixel {
    way: DeviceId<Interface>,
    data: Vec<u8>,
    frame: JobSlot<Frame>,
    /// Whether the log already has a line about failed sending.
    failing: bool,
}

impl Neopixel {
    fn update(&mut self, pos: u16, bytes: &[u8]) -> Result<(), Shutdown> {
        let size = self.data.len();
        let pos = usize::from(pos);
        let part = self.data.get_mut(pos..pos + bytes.len());
        let part = part.ok_or_else(|| {
            let what = format_args!("bytes {pos} to {} of a chain of {size}", pos + bytes.len());
            Shutdown::by_host(INVALID_UPDATE, what)
        })?;
        part.copy_from_slice(bytes);
        Ok(())
    }

    fn send(&mut self, context: &mut Context) -> Result<(), Shutdown> {
        // Commands wait for each other, so the frame is here.
        let Some(frame) = self.frame.here() else {
            return Err(Shutdown::by_host(reason::WORKER_OVERFLOW, "neopixel_send came during another one"));
        };
        frame.data.copy_from_slice(&self.data);
        self.frame.send(context, self.way)
    }
}

impl Object for Neopixel {
    fn kind(&self) -> &'static str {
        "neopixel"
    }

    fn finished(&mut self, context: &mut Context, _number: u8, finished: Finished) -> Result<(), Shutdown> {
        let Some(Back { result, .. }) = self.frame.back(finished) else { return Ok(()) };
        context.send(Sent { oid: context.oid(), success: result == Ok(true) });
        // No color is worth a print. klippy tries eight times for each change, so only the first failure is logged.
        let known = std::mem::replace(&mut self.failing, result.is_err());
        if let (Err(error), false) = (result, known) {
            let trouble = error.clone();
            context.warn(self.kind(), trouble);
        }
        Ok(())
    }
}

/// The way to the LEDs at a pin.
fn way(
    context: &mut Context,
    pin: Pin,
    size: usize,
    bit_max: Ticks,
    reset: Ticks,
) -> Result<DeviceId<Interface>, Shutdown> {
    let Some(mosi) = context.board()?.mosi(pin, spi::RATE_HZ)? else {
        let line = context.prompt_line(pin, "LED", Direction::at_rest(false))?;
        let pulses = Pulses::new(context, pin, line, size, bit_max, reset)?;
        return context.device(line::WORKER, Box::new(Interface::Line(pulses)));
    };
    let Mosi { line: OnWorker { bus, device }, message_max, pauses } = mosi;
    let waves = Waves::new(device, size, reset, message_max).map_err(|error| error.of(&context.name(pin)))?;
    if let Some(trouble) = pauses {
        context.warn_of_device(&DeviceWarning::new("", trouble));
    }
    context.device(&bus, Box::new(Interface::Spi(waves)))
}

const CONFIG_NEOPIXEL: Command = command!(
    "config_neopixel oid=%c pin=%u data_size=%hu bit_max_ticks=%u reset_min_ticks=%u",
    |context, oid: Oid, pin: Pin, data_size: u16, bit_max_ticks: Ticks, reset_min_ticks: Ticks| {
        context.vacant(oid)?;
        if data_size >= SIZE_LIMIT {
            return Err(Shutdown::by_host(INVALID_SIZE, format_args!("a chain of {data_size} bytes")));
        }
        let size = usize::from(data_size);
        let way = way(context, pin, size, bit_max_ticks, reset_min_ticks.max(RESET_MIN))?;
        let frame = JobSlot::new(Frame { data: vec![0; size], warning: None });
        context.assign_on(pin, oid, Neopixel { way, data: vec![0; size], frame, failing: false })
    }
);

const NEOPIXEL_UPDATE: Command =
    command!("neopixel_update oid=%c pos=%hu data=%*s", Neopixel, |chain, _, pos: u16, data: &[u8]| chain
        .update(pos, data));

const NEOPIXEL_SEND: Command = command!("neopixel_send oid=%c", Neopixel, |chain, context| chain.send(context));
