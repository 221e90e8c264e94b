// SPDX-License-Identifier: GPL-3.0-or-later
//! Why the MCU stops: Klipper's short text for the wire, and a long text for the log.

use std::fmt;
use std::ops::Deref;

use crate::time::Clock;
use crate::trouble::Trouble;

/// A shutdown text of Klipper's C, as the host sees it. The wording is Klipper's own: klippy shows the text to the
/// user and matches some texts (`klippy/extras/error_mcu.py`).
///
/// [`shutdowns!`] declares one. The dictionary numbers the texts that the features list, in its enumeration
/// `static_string_id`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ShutdownReason(&'static str);

impl ShutdownReason {
    /// The reason with this text. [`shutdowns!`] also lists it.
    pub(crate) const fn new(text: &'static str) -> ShutdownReason {
        ShutdownReason(text)
    }

    /// The text that the host shows.
    pub const fn text(self) -> &'static str {
        self.0
    }
}

/// Declares the shutdown texts of a feature as constants. It also declares their list `SHUTDOWNS` for the
/// [`Feature`](crate::mcu::Feature).
macro_rules! shutdowns {
    ($($(#[$doc:meta])* $vis:vis $name:ident = $text:literal;)*) => {
        $($(#[$doc])* $vis const $name: $crate::shutdown::ShutdownReason =
            $crate::shutdown::ShutdownReason::new($text);)*
        /// All shutdown texts of this module.
        pub(crate) const SHUTDOWNS: &[$crate::shutdown::ShutdownReason] = &[$($name),*];
    };
}

pub(crate) use shutdowns;

/// The shutdown texts of the MCU itself and of its boards. A feature's texts are in its file.
pub mod reason {
    shutdowns! {
        /// `clear_shutdown` while running.
        pub NOT_SHUTDOWN = "Shutdown cleared when not shutdown";
        /// A timer was started for a time that has passed.
        pub TIMER_TOO_CLOSE = "Timer too close";
        /// A command id that the dictionary does not have.
        pub INVALID_COMMAND = "Invalid command";
        /// A command whose parameters end before it does.
        pub COMMAND_PARSER = "Command parser error";
        /// `emergency_stop` (M112).
        pub COMMAND_REQUEST = "Command request";
        /// `config_reset` while running.
        pub CONFIG_RESET_RUNNING = "config_reset only available when shutdown";
        /// `allocate_oids` twice.
        pub OIDS_ALLOCATED = "oids already allocated";
        /// An oid that is out of range or taken, or a config command after `finalize_config`.
        pub CANNOT_ASSIGN_OID = "Can't assign oid";
        /// An oid that is out of range or of another kind.
        pub INVALID_OID = "Invalid oid type";
        /// `finalize_config` twice.
        pub ALREADY_FINALIZED = "Already finalized";
        /// The host queued more moves than `move_count`.
        pub MOVE_QUEUE_OVERFLOW = "Move queue overflow";
        /// A timer fell over 100 ms behind.
        pub TIMER_PAST = "Rescheduled timer in the past";
        /// `FORCE_SHUTDOWN` written to the pty, SIGTERM or SIGINT.
        pub FORCE_SHUTDOWN = "Force shutdown command";
        /// An SPI device is missing or not permitted.
        pub SPI_OPEN = "Unable to open spi device";
        /// The driver refuses an SPI rate.
        pub SPI_SPEED = "Unable to set SPI speed";
        /// The driver refuses an SPI mode.
        pub SPI_MODE = "Unable to set SPI mode";
        /// An I2C bus is missing or not permitted.
        pub I2C_OPEN = "Unable to open i2c device";
        /// A serial port is missing, in use or not permitted (Pinion's own text).
        pub SERIAL_OPEN = "Unable to open serial port";
        /// A DS18B20 is missing or not permitted.
        pub DS18B20_OPEN = "Invalid DS18B20 serial id, could not open for reading";
        /// A hardware PWM channel is missing, not permitted, or refuses its period.
        pub PWM_CONFIG = "Unable to config pwm device";
        /// A write to a hardware PWM channel failed (Pinion's own text).
        pub PWM_WRITE = "PWM write failed";
        /// An ADC read failed.
        pub ADC_READ = "Error on analog read";
        /// An ADC channel is missing or not permitted.
        pub ADC_OPEN = "Unable to open adc device";
        /// A line cannot be requested as an input.
        pub INPUT_LINE = "Unable to open in GPIO chip line";
        /// A pin number is not an input.
        pub NOT_INPUT = "Not an input pin";
        /// A line cannot be requested as an output.
        pub OUTPUT_LINE = "Unable to open out GPIO chip line";
        /// A pin number is not an output.
        pub NOT_OUTPUT = "Not an output pin";
        /// A chip exists but cannot be opened.
        pub CHIP_OPEN = "Unable to open GPIO chip device";
        /// A chip does not exist.
        pub CHIP_MISSING = "GPIO chip device not found";
        /// A write to a claimed line failed (Pinion's own text: Klipper's C does not notice this).
        pub LINE_WRITE = "GPIO line write failed";
        /// A read of a claimed line failed (Pinion's own text).
        pub LINE_READ = "GPIO line read failed";
        /// `debug_read` or `debug_write` (Pinion's own text).
        pub DEBUG_MEMORY = "Memory access is not available on Linux";
        /// A worker's queue is full: the host asks more of the bus than it can do (Pinion's own text).
        pub WORKER_OVERFLOW = "Bus worker queue overflow";
        /// A job that a command began does not end (Pinion's own text).
        pub BUS_HANGS = "Bus does not answer";
        /// No host can come any more: the program's input has ended (Pinion's own text).
        pub HOST_LOST = "Lost communication with host";
        /// The guardian process is gone (Pinion's own text).
        pub GUARDIAN_LOST = "Guardian process lost";
    }
}

/// A stop of the MCU: the reason for the wire, and the trouble for the log.
///
/// Creating one allocates. That is allowed, because the MCU stops anyway. It is a single pointer, so that a handler
/// returns its result in registers.
#[derive(Clone, Debug, PartialEq)]
pub struct Shutdown(Box<Stop>);

/// The parts of a [`Shutdown`].
#[derive(Clone, Debug, PartialEq)]
pub struct Stop {
    /// The text for the wire.
    pub reason: ShutdownReason,
    /// The text for the log.
    pub trouble: Trouble,
    /// The time that the stop is about: an event came too late for it.
    pub due: Option<Clock>,
}

impl Deref for Shutdown {
    type Target = Stop;

    fn deref(&self) -> &Stop {
        &self.0
    }
}

impl Shutdown {
    /// A stop with this reason. A text alone is its cause.
    #[cold]
    pub fn because(reason: ShutdownReason, trouble: impl Into<Trouble>) -> Shutdown {
        Shutdown(Box::new(Stop { reason, trouble: trouble.into(), due: None }))
    }

    /// The same stop, with this remedy.
    #[cold]
    pub fn remedy(mut self, remedy: impl Into<Box<str>>) -> Shutdown {
        self.0.trouble.remedy = Some(remedy.into());
        self
    }

    /// The same stop, for an event that came too late for its time.
    #[cold]
    pub fn late_for(mut self, due: impl Into<Option<Clock>>) -> Shutdown {
        self.0.due = due.into();
        self
    }

    /// A stop for a command that no correct host would send at that point.
    #[cold]
    pub fn by_host(reason: ShutdownReason, what: impl fmt::Display) -> Shutdown {
        Shutdown::because(reason, format!("{what}: a fault of the host"))
            .remedy("FIRMWARE_RESTART, and report it with its log")
    }

    /// The same stop, with this object as its subject.
    #[cold]
    pub fn of(self, object: &str) -> Shutdown {
        let Stop { reason, trouble, due } = *self.0;
        Shutdown(Box::new(Stop { reason, trouble: trouble.of(object), due }))
    }

    /// The text for the log.
    #[cold]
    pub fn into_trouble(self) -> Trouble {
        self.0.trouble
    }
}

impl fmt::Display for Shutdown {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.reason.text(), self.trouble)
    }
}
