// SPDX-License-Identifier: GPL-3.0-or-later
//! Why the machine stops: the firmware's short text for the wire, a long one for the log.

#![forbid(unsafe_code)]

use std::fmt;

macro_rules! reasons {
    ($($(#[$doc:meta])* $name:ident = $text:literal;)*) => {
        /// A shutdown text of the firmware. klippy shows it to the user and matches some of
        /// them (`klippy/extras/error_mcu.py`), so the wording is Klipper's own.
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        #[repr(u8)]
        pub enum Reason { $($(#[$doc])* $name),* }

        impl Reason {
            /// Every reason in the order of its id.
            pub const ALL: &'static [Reason] = &[$(Reason::$name),*];

            /// The text that the host shows.
            pub const fn text(self) -> &'static str {
                match self { $(Reason::$name => $text),* }
            }
        }
    };
}

reasons! {
    /// `clear_shutdown` while running.
    NotShutdown = "Shutdown cleared when not shutdown";
    /// A timer was added for an instant that has passed.
    TimerTooClose = "Timer too close";
    /// A command id that the dictionary does not have.
    InvalidCommand = "Invalid command";
    /// A command whose parameters end before it does.
    CommandParser = "Command parser error";
    /// `emergency_stop` (M112).
    CommandRequest = "Command request";
    /// `config_reset` while running.
    ConfigResetRunning = "config_reset only available when shutdown";
    /// `allocate_oids` twice.
    OidsAllocated = "oids already allocated";
    /// An oid that is out of range or taken, or a config command after `finalize_config`.
    CannotAssignOid = "Can't assign oid";
    /// An oid that is out of range or of another kind.
    InvalidOid = "Invalid oid type";
    /// `finalize_config` twice.
    AlreadyFinalized = "Already finalized";
    /// The host queued more moves than `move_count`.
    MoveQueueOverflow = "Move queue overflow";
    /// `update_digital_out` while changes are queued.
    UpdateWithQueue = "update_digital_out not valid with active queue";
    /// An output would stay on for longer than its `max_duration`.
    DigitalMaxDuration = "Scheduled digital out event will exceed max_duration";
    /// `set_digital_out_pwm_cycle` while changes are queued.
    PwmCycleWithQueue = "Can not set soft pwm cycle ticks while updates pending";
    /// The host did not refresh an output before its `max_duration` ran out.
    MissedDigital = "Missed scheduling of next digital out event";
    /// `reset_step_clock` while steps are queued.
    ResetWhileStepping = "Can't reset time when stepper active";
    /// `queue_step` with a count of zero.
    InvalidCount = "Invalid count parameter";
    /// A step over a millisecond late.
    StepperPast = "Stepper too far in past";
    /// `stepper_stop_on_trigger` for a stepper that already waits for a trigger.
    SignalActive = "Can't add signal that is already active";
    /// `bytes_per_report` above 48.
    InvalidBytesPerReport = "Invalid analog_in bytes_per_report";
    /// A reading outside its range, `range_check_count` times in a row.
    AdcRange = "ADC out of range";
    /// An SPI mode above 3, or a second bus for one device.
    InvalidSpi = "Invalid spi config";
    /// A timer fell over 100 ms behind.
    TimerPast = "Rescheduled timer in the past";
    /// `FORCE_SHUTDOWN` written to the pty, SIGTERM or SIGINT.
    ForceShutdown = "Force shutdown command";
    /// An SPI transfer failed.
    SpiTransfer = "Unable to issue spi ioctl";
    /// An SPI device that is not there or not permitted.
    SpiOpen = "Unable to open spi device";
    /// An SPI rate that the driver refuses.
    SpiSpeed = "Unable to set SPI speed";
    /// An SPI mode that the driver refuses.
    SpiMode = "Unable to set SPI mode";
    /// A hardware PWM channel that is not there, not permitted or refuses its period.
    PwmConfig = "Unable to config pwm device";
    /// A hardware PWM output would stay on for longer than its `max_duration`.
    PwmMaxDuration = "Scheduled pwm event will exceed max_duration";
    /// The host did not refresh a hardware PWM output in time.
    MissedPwm = "Missed scheduling of next hard pwm event";
    /// A hardware PWM channel can no longer be written (Pinion's own text).
    PwmWrite = "PWM write failed";
    /// An ADC read failed.
    AdcRead = "Error on analog read";
    /// An ADC channel that is not there or not permitted.
    AdcOpen = "Unable to open adc device";
    /// A line that can not be requested as an input.
    InputLine = "Unable to open in GPIO chip line";
    /// A pin number that is no input.
    NotInput = "Not an input pin";
    /// A line that can not be requested as an output.
    OutputLine = "Unable to open out GPIO chip line";
    /// A pin number that is no output.
    NotOutput = "Not an output pin";
    /// A chip that is there and can not be opened.
    ChipOpen = "Unable to open GPIO chip device";
    /// A chip that is not there.
    ChipMissing = "GPIO chip device not found";
    /// A line that was granted and can no longer be written (Pinion's own text: the firmware
    /// does not notice).
    LineWrite = "GPIO line write failed";
    /// A line that was granted and can no longer be read (Pinion's own text).
    LineRead = "GPIO line read failed";
    /// `debug_read` or `debug_write` (Pinion's own text).
    DebugMemory = "Memory access is not available on Linux";
    /// A worker's queue is full: the bus is slower than what the host asks of it (Pinion's own
    /// text).
    WorkerOverflow = "Bus worker queue overflow";
    /// The guardian process is gone (Pinion's own text).
    GuardianLost = "Guardian process lost";
}

/// A stop of the machine: the reason, and for the log what it was about and what to do.
///
/// The detail is made as the machine stops, when lateness no longer counts.
#[derive(Debug, PartialEq)]
pub struct Shutdown {
    /// What goes over the wire.
    pub reason: Reason,
    /// Cause, subject and remedy, for the log.
    pub detail: Box<str>,
}

impl Shutdown {
    /// A stop whose log line names the thing and the remedy.
    pub fn because(reason: Reason, detail: impl Into<Box<str>>) -> Shutdown {
        Shutdown { reason, detail: detail.into() }
    }

    /// A stop for a command that can not be right where it came.
    #[cold]
    pub fn by_host(reason: Reason, what: impl fmt::Display) -> Shutdown {
        Shutdown::because(reason, format!("{what}: a fault of the host; FIRMWARE_RESTART, and report it with its log"))
    }

    /// Says which object it was about.
    #[cold]
    pub fn of(self, kind: &str, oid: impl fmt::Display) -> Shutdown {
        Shutdown::because(self.reason, format!("{kind} oid {oid}: {}", self.detail))
    }
}

impl fmt::Display for Shutdown {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.reason.text(), self.detail)
    }
}
