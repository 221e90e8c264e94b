// SPDX-License-Identifier: GPL-3.0-or-later
//! Why the MCU stops: the firmware's short text for the wire, and a long one for the log.

#![forbid(unsafe_code)]

use std::fmt;

use crate::trouble::Trouble;

/// A shutdown text of the firmware, as the host sees it. klippy shows it to the user and matches
/// some of them (`klippy/extras/error_mcu.py`), so the wording is Klipper's own.
///
/// [`shutdowns!`] declares one. The dictionary numbers those that the features list (its
/// enumeration `static_string_id`).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ShutdownReason(&'static str);

impl ShutdownReason {
    /// The reason with this text; [`shutdowns!`] lists it as well.
    pub(crate) const fn new(text: &'static str) -> ShutdownReason {
        ShutdownReason(text)
    }

    /// The text that the host shows.
    pub const fn text(self) -> &'static str {
        self.0
    }
}

/// Declares the shutdown texts of a feature as constants, and `SHUTDOWNS`, the list of them that
/// goes into its [`Feature`](crate::mcu::Feature).
macro_rules! shutdowns {
    ($($(#[$doc:meta])* $vis:vis $name:ident = $text:literal;)*) => {
        $($(#[$doc])* $vis const $name: $crate::shutdown::ShutdownReason =
            $crate::shutdown::ShutdownReason::new($text);)*
        /// All of these.
        pub(crate) const SHUTDOWNS: &[$crate::shutdown::ShutdownReason] = &[$($name),*];
    };
}

pub(crate) use shutdowns;

/// The texts of the MCU itself and of its boards. Those of a feature stand in its file.
pub mod reason {
    shutdowns! {
        /// `clear_shutdown` while running.
        pub NOT_SHUTDOWN = "Shutdown cleared when not shutdown";
        /// A timer was added for an instant that has passed.
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
        /// An SPI device that is not there or not permitted.
        pub SPI_OPEN = "Unable to open spi device";
        /// An SPI rate that the driver refuses.
        pub SPI_SPEED = "Unable to set SPI speed";
        /// An SPI mode that the driver refuses.
        pub SPI_MODE = "Unable to set SPI mode";
        /// An I2C bus that is not there or not permitted.
        pub I2C_OPEN = "Unable to open i2c device";
        /// A DS18B20 that is not there or not permitted.
        pub DS18B20_OPEN = "Invalid DS18B20 serial id, could not open for reading";
        /// A hardware PWM channel that is not there, not permitted or refuses its period.
        pub PWM_CONFIG = "Unable to config pwm device";
        /// A hardware PWM channel can no longer be written (Pinion's own text).
        pub PWM_WRITE = "PWM write failed";
        /// An ADC read failed.
        pub ADC_READ = "Error on analog read";
        /// An ADC channel that is not there or not permitted.
        pub ADC_OPEN = "Unable to open adc device";
        /// A line that can not be requested as an input.
        pub INPUT_LINE = "Unable to open in GPIO chip line";
        /// A pin number that is no input.
        pub NOT_INPUT = "Not an input pin";
        /// A line that can not be requested as an output.
        pub OUTPUT_LINE = "Unable to open out GPIO chip line";
        /// A pin number that is no output.
        pub NOT_OUTPUT = "Not an output pin";
        /// A chip that is there and can not be opened.
        pub CHIP_OPEN = "Unable to open GPIO chip device";
        /// A chip that is not there.
        pub CHIP_MISSING = "GPIO chip device not found";
        /// A line that was granted and can no longer be written (Pinion's own text: the firmware
        /// does not notice).
        pub LINE_WRITE = "GPIO line write failed";
        /// A line that was granted and can no longer be read (Pinion's own text).
        pub LINE_READ = "GPIO line read failed";
        /// `debug_read` or `debug_write` (Pinion's own text).
        pub DEBUG_MEMORY = "Memory access is not available on Linux";
        /// A worker's queue is full: the bus is slower than what the host asks of it (Pinion's own
        /// text).
        pub WORKER_OVERFLOW = "Bus worker queue overflow";
        /// A bus conversation that a command began does not end (Pinion's own text).
        pub BUS_HANGS = "Bus does not answer";
        /// The guardian process is gone (Pinion's own text).
        pub GUARDIAN_LOST = "Guardian process lost";
    }
}

/// A stop of the MCU: the reason for the wire, and the trouble for the log.
///
/// Making one allocates. That is allowed, as it is made when the MCU stops anyway.
#[derive(Clone, Debug, PartialEq)]
pub struct Shutdown {
    /// What goes over the wire.
    pub reason: ShutdownReason,
    /// What the log says. It is boxed, as every handler returns room for a stop.
    pub trouble: Box<Trouble>,
}

impl Shutdown {
    /// A stop with this reason; a text alone is its cause.
    #[cold]
    pub fn because(reason: ShutdownReason, trouble: impl Into<Trouble>) -> Shutdown {
        Shutdown { reason, trouble: Box::new(trouble.into()) }
    }

    /// The same stop, with what to do about it.
    #[cold]
    pub fn remedy(self, remedy: impl Into<Box<str>>) -> Shutdown {
        Shutdown::because(self.reason, self.trouble.remedy(remedy))
    }

    /// A stop for a command that no correct host would send at that point.
    #[cold]
    pub fn by_host(reason: ShutdownReason, what: impl fmt::Display) -> Shutdown {
        Shutdown::because(reason, format!("{what}: a fault of the host"))
            .remedy("FIRMWARE_RESTART, and report it with its log")
    }

    /// The same stop, of this object.
    #[cold]
    pub fn of(self, object: &str) -> Shutdown {
        Shutdown::because(self.reason, self.trouble.of(object))
    }
}

impl fmt::Display for Shutdown {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.reason.text(), self.trouble)
    }
}
