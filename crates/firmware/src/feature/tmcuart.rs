// SPDX-License-Identifier: GPL-3.0-or-later
//! The UART of Trinamic's stepper drivers (TMC2208, TMC2209 and similar), on one wire or two. klippy writes the start
//! and stop bits itself, checks the reply's, and asks again.
//!
//! The pins are GPIO lines (`lines.rs`) or a serial port of the computer (`port.rs`).

use crate::board::{Bias, Direction, OnWorker, Pin};
use crate::mcu::{
    Back, Command, Context, DeviceId, DeviceWarning, Feature, Finished, Job, JobSlot, Next, Object, Oid, Response,
    Safe, Timer, command, response,
};
use crate::shutdown::{Shutdown, reason, shutdowns};
use crate::time::{CLOCK_FREQ, Clock, Ticks};

use super::pace::Pace;
use lines::{Lines, Wire};
use port::Port;

mod lines;
mod port;

pub(super) const FEATURE: Feature = Feature {
    serves: "TMC drivers on a UART",

    commands: &[CONFIG_TMCUART, TMCUART_SEND],
    responses: &[UartResponse::FORM],
    shutdowns: SHUTDOWNS,
    ..Feature::EMPTY
};

shutdowns! {
    /// `tmcuart_send` with more than ten bytes to send or to read.
    DATA_TOO_LARGE = "tmcuart data too large";
}

response! {
    /// A message was sent. `read` has the bits of the reply, from its first start bit on. It is empty if no reply was
    /// requested or none came.
    "tmcuart_response oid=%c read=%*s"
    pub(super) struct UartResponse<'a> { oid: Oid, read: &'a [u8] }
}

/// All UARTs on lines share a worker, because klippy talks to one at a time (`PrinterTMCUartMutexes` in tmc_uart.py).
const WORKER: &str = "tmcuart";
/// Highest number of bytes in a message, with start and stop bits: eight bytes of ten bits.
const DATA_MAX: usize = 10;
/// How long the line is quiet between the command and the first edge, as in Klipper's C. A driver wants a quiet line
/// between messages.
const QUIET: Ticks = Ticks::from_us(200);
/// How long to wait after a message before the search for the reply, in bits.
const TURN_BITS: u32 = 4;
/// Longest search for the reply, in bits.
const REPLY_BITS: u32 = 65;
/// Pause of a driver before its reply: 24 bits with klippy's SENDDELAY of 2 (TMC2209 data sheet, section 5.1), and some.
const REPLY_PAUSE: u32 = 28;
/// A byte with its start and its stop bit.
const FRAME_BITS: usize = 10;
const TIMER: Timer = Timer::exact(0);

/// A message and its reply, with start and stop bits. The first bit is the lowest of the first byte.
#[derive(Default)]
struct Message {
    data: [u8; DATA_MAX],
    write_len: usize,
    reply: [u8; DATA_MAX],
    read_len: usize,
    /// Whether a reply came.
    replied: bool,
}

impl Message {
    /// The bits to send.
    fn bits(&self) -> &[u8] {
        &self.data[..self.write_len]
    }

    /// How many bits the message and its reply take together.
    fn bits_max(&self) -> u32 {
        let pause = if self.read_len > 0 { REPLY_PAUSE } else { 0 };
        8 * (self.write_len + self.read_len) as u32 + pause
    }

    fn reply(&self) -> &[u8] {
        if self.replied { &self.reply[..self.read_len] } else { &[] }
    }
}

/// The bit at this place.
fn bit_of(bits: &[u8], place: usize) -> bool {
    bits[place / 8] >> (place % 8) & 1 != 0
}

/// The way to the drivers.
enum Interface {
    Lines(Lines),
    Port(Port),
}

/// Sends a message and receives its reply.
#[derive(Default)]
struct Exchange {
    message: Message,
    warning: Option<DeviceWarning>,
}

impl Job for Exchange {
    type Device = Interface;
    type Out = ();
    type Failure = Shutdown;

    fn run(&mut self, way: &mut Interface) -> Result<(), Shutdown> {
        self.message.replied = false;
        match way {
            Interface::Lines(lines) => lines.exchange(&mut self.message),
            Interface::Port(port) => {
                port.exchange(&mut self.message);
                self.warning = port.warning.take();
                Ok(())
            }
        }
    }

    fn take_warning(&mut self) -> Option<DeviceWarning> {
        self.warning.take()
    }
}

struct TmcUart {
    way: DeviceId<Interface>,
    /// The wire, if no port drives it. A port is idle whenever it does not send.
    wire: Option<Wire>,
    pace: Pace,
    exchange: JobSlot<Exchange>,
    /// Whether the host still expects an answer.
    asked: bool,
}

impl TmcUart {
    fn send(&mut self, context: &mut Context, write: &[u8], read_len: u8) -> Result<(), Shutdown> {
        // As in Klipper's C: a busy UART ignores the command, and the host asks again.
        let Some(exchange) = self.exchange.here().filter(|_| !self.asked) else { return Ok(()) };
        let read_len = usize::from(read_len);
        if write.len() > DATA_MAX || read_len > DATA_MAX {
            return Err(Shutdown::by_host(
                DATA_TOO_LARGE,
                format_args!(
                    "tmcuart_send sends {} bytes and reads {read_len}, but at most {DATA_MAX} each are possible",
                    write.len()
                ),
            ));
        }
        let message = &mut exchange.message;
        message.data[..write.len()].copy_from_slice(write);
        message.write_len = write.len();
        message.read_len = read_len;
        self.asked = true;
        let at = context.now() + QUIET;
        context.go_on(TIMER, at);
        Ok(())
    }
}

impl Object for TmcUart {
    fn kind(&self) -> &'static str {
        "TMC UART"
    }

    /// Sends the message from a timer, so that no command waits for it.
    fn event(&mut self, context: &mut Context, _timer: Timer, _at: Clock) -> Result<Next, Shutdown> {
        self.exchange.send(context, self.way)?;
        Ok(Next::Done)
    }

    fn finished(&mut self, context: &mut Context, _number: u8, finished: Finished) -> Result<(), Shutdown> {
        let Some(Back { result, .. }) = self.exchange.back(finished) else { return Ok(()) };
        let result = result.map_err(Shutdown::clone);
        self.pace.resume();
        if std::mem::take(&mut self.asked)
            && result.is_ok()
            && let Some(exchange) = self.exchange.here()
        {
            context.send(UartResponse { oid: context.oid(), read: exchange.message.reply() });
        }
        match result {
            Ok(()) => {
                context.is_safe();
                Ok(())
            }
            Err(failure) => context.device_failed(self.kind(), failure),
        }
    }

    fn shutdown(&mut self, _context: &mut Context) {
        self.asked = false;
    }

    /// Aborts a message under way. The job then leaves the line idle.
    fn make_safe(&mut self, _context: &mut Context) -> Result<Safe, Shutdown> {
        if self.exchange.is_here() {
            return self.wire.as_ref().map_or(Ok(()), Wire::idle).map(|()| Safe::Now);
        }
        self.pace.stop();
        Ok(Safe::Later)
    }
}

/// Claims two lines, or one for both directions.
fn lines(context: &mut Context, rx_pin: Pin, tx_pin: Pin, bias: Bias, bit: Ticks) -> Result<Lines, Shutdown> {
    let rx = context.prompt_line(rx_pin, "UART", Direction::Input(bias))?;
    let (tx, single) = if rx_pin == tx_pin {
        (rx.clone(), Some(bias))
    } else {
        (context.prompt_line(tx_pin, "UART", Direction::at_rest(true))?, None)
    };
    let lines = Lines { wire: Wire { tx, single }, rx, pace: Pace::between_ticks(context), bit, spoilt: false };
    lines.wire.idle()?;
    Ok(lines)
}

const CONFIG_TMCUART: Command = command!(
    "config_tmcuart oid=%c rx_pin=%u pull_up=%c tx_pin=%u bit_time=%u",
    |context, oid: Oid, rx_pin: Pin, pull_up: bool, tx_pin: Pin, bit_time: Ticks| {
        context.vacant(oid)?;
        // The device tree sets the resistors at a port's pins.
        let (way, wire, pace) = match context.board()?.serial(rx_pin, rate_hz(bit_time))? {
            Some(_) if rx_pin != tx_pin => {
                let (rx, tx) = (context.name(rx_pin), context.name(tx_pin));
                let cause = format!("it cannot receive on {rx} and send on {tx}, because a serial port does both");
                return Err(Shutdown::because(reason::SERIAL_OPEN, cause).remedy("remove tx_pin"));
            }
            Some(OnWorker { bus, device }) => {
                let port = Port::new(device, context.name(rx_pin), bit_time);
                (context.device(&bus, Box::new(Interface::Port(port)))?, None, Pace::new(context))
            }
            None => {
                let bias = if pull_up { Bias::PullUp } else { Bias::None };
                let lines = lines(context, rx_pin, tx_pin, bias, bit_time)?;
                let (wire, pace) = (lines.wire.clone(), lines.pace.clone());
                (context.device(WORKER, Box::new(Interface::Lines(lines)))?, Some(wire), pace)
            }
        };
        let exchange = JobSlot::new(Exchange::default());
        context.assign_on(tx_pin, oid, TmcUart { way, wire, pace, exchange, asked: false })
    }
);

/// Bits per second.
fn rate_hz(bit_time: Ticks) -> u32 {
    (CLOCK_FREQ + bit_time.0 / 2) / bit_time.0.max(1)
}

const TMCUART_SEND: Command =
    command!("tmcuart_send oid=%c write=%*s read=%c", TmcUart, |uart, context, write: &[u8], read: u8| uart
        .send(context, write, read));
