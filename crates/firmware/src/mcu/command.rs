// SPDX-License-Identifier: GPL-3.0-or-later
//! Declarations of commands and responses. A format, its typed parameters and its handler stand together. If they
//! disagree, the build fails.

use crate::board::{Board, Range};
use crate::shutdown::{Shutdown, ShutdownReason, reason};
use pinion_protocol::Malformed;
use pinion_protocol::format::same;
use pinion_protocol::vlq::{Reader, Writer};

use super::{DialectName, Hosts, Mcu, Wire};

impl From<Malformed> for Shutdown {
    /// The cause is empty. [`Mcu::execute`] adds the name of the command.
    #[cold]
    fn from(_: Malformed) -> Shutdown {
        Shutdown::because(reason::COMMAND_PARSER, "")
    }
}

/// Decodes a command's parameters and runs the command. An error stops the MCU.
pub type Handler = fn(&mut Mcu, &mut Reader<'_>) -> Result<(), Shutdown>;

/// A command that the host may send.
pub struct Command {
    /// Name, parameters and their conversions, exactly as klippy looks them up.
    pub format: &'static str,
    /// The hosts that use this form.
    pub hosts: Hosts,
    /// Whether it also runs after a shutdown.
    pub in_shutdown: bool,
    /// Whether it may join a command of the same kind: see [`Command::joining`].
    pub joins: bool,
    /// Decodes the parameters and runs the command.
    pub handler: Handler,
}

impl Command {
    /// A command for all hosts that runs while the MCU is not stopped. [`command!`](crate::command) declares one.
    pub const fn new(format: &'static str, handler: Handler) -> Command {
        Command { format, hosts: Hosts::ALL, in_shutdown: false, joins: false, handler }
    }

    /// Lets the command run after a shutdown too (`HF_IN_SHUTDOWN`).
    pub const fn allowed_in_shutdown(mut self) -> Command {
        self.in_shutdown = true;
        self
    }

    /// Lets the command run while other commands wait for a job of the same kind of command. Their object must [let
    /// others join](super::Context::let_join). The first parameter must be the oid.
    pub const fn joining(mut self) -> Command {
        self.joins = true;
        self
    }

    /// The dialects that have this form. Without this, all have it. Hosts that look it up get it anyway.
    pub const fn of(self, dialects: &'static [DialectName]) -> Command {
        self.hosts(Hosts::of(dialects))
    }

    /// The hosts that use this form. Without this, all do.
    pub const fn hosts(mut self, hosts: Hosts) -> Command {
        self.hosts = hosts;
        self
    }
}

/// A form of a response, as the dictionary lists it.
pub struct Form {
    /// Name, parameters and their conversions.
    pub format: &'static str,
    /// The hosts that use this form.
    pub hosts: Hosts,
}

/// A message to the host.
pub trait Response {
    /// Its format, and the hosts that use it.
    const FORM: Form;
    /// Its place in the list of all features' responses.
    const INDEX: usize;
    /// Appends the parameters.
    fn encode(&self, writer: &mut Writer);
}

/// A constant of the dictionary.
pub struct Constant {
    /// Its name, for example `ADC_MAX`.
    pub name: &'static str,
    /// Its value.
    pub value: ConstantValue,
    /// The hosts whose dictionary has it.
    pub hosts: Hosts,
}

/// The value of a constant.
pub enum ConstantValue {
    /// A number.
    Number(u32),
    /// A text.
    Text(&'static str),
}

impl Constant {
    /// A constant that is a number.
    pub const fn number(name: &'static str, number: u32) -> Constant {
        Constant { name, value: ConstantValue::Number(number), hosts: Hosts::ALL }
    }

    /// A constant that is a text.
    pub const fn text(name: &'static str, text: &'static str) -> Constant {
        Constant { name, value: ConstantValue::Text(text), hosts: Hosts::ALL }
    }

    /// The dialects whose dictionary has it. Without this, all do. Hosts that look it up get it anyway.
    pub const fn of(mut self, dialects: &'static [DialectName]) -> Constant {
        self.hosts = Hosts::of(dialects);
        self
    }
}

/// An enumeration of the dictionary. Its names may depend on the board.
pub struct Enumeration {
    /// Its name, for example `spi_bus`.
    pub name: &'static str,
    /// The names on this board, and their values.
    pub values: fn(&dyn Board) -> Vec<Range>,
    /// The hosts whose dictionary has it.
    pub hosts: Hosts,
}

impl Enumeration {
    /// An enumeration.
    pub const fn new(name: &'static str, values: fn(&dyn Board) -> Vec<Range>) -> Enumeration {
        Enumeration { name, values, hosts: Hosts::ALL }
    }

    /// The dialects whose dictionary has it with these values. Without this, all do. Hosts that look it up get it anyway.
    pub const fn of(mut self, dialects: &'static [DialectName]) -> Enumeration {
        self.hosts = Hosts::of(dialects);
        self
    }
}

/// A feature's entries in the dictionary. [`Feature::EMPTY`] provides the fields that a feature does not need.
pub struct Feature {
    /// The part of a printer that it serves, in words of printer.cfg.
    pub serves: &'static str,
    /// Its commands. Of the forms of a name, the oldest comes first.
    pub commands: &'static [Command],
    /// Its responses. Of the forms of a name, the oldest comes first.
    pub responses: &'static [Form],
    /// Its constants.
    pub constants: &'static [Constant],
    /// Its enumerations.
    pub enumerations: &'static [Enumeration],
    /// Its shutdown texts: the `SHUTDOWNS` that [`shutdowns!`](crate::shutdown::shutdowns) makes.
    pub shutdowns: &'static [ShutdownReason],
    /// Whether the MCU has it on this wire.
    pub is_on: fn(&Wire) -> bool,
}

impl Feature {
    /// A feature that adds nothing.
    pub const EMPTY: Feature = Feature {
        serves: "",
        commands: &[],
        responses: &[],
        constants: &[],
        enumerations: &[],
        shutdowns: &[],
        is_on: |_wire| true,
    };
}

/// Declares a command: its format, and a closure with the [`Context`](crate::mcu::Context) and the typed parameters.
///
/// A command to an object names the object's type after the format. Its first parameter is the object's `oid`. Its
/// closure gets the object in front of the context, and no oid. A closure with `mcu: &mut Mcu` is for the MCU's own
/// commands.
#[macro_export]
macro_rules! command {
    ($format:literal, |$context:ident $(, $arg:ident: $t:ty)* $(,)?| $body:expr $(,)?) => {
        $crate::command!($format, |mcu: &mut Mcu $(, $arg: $t)*| {
            let $context = &mut mcu.context();
            #[allow(unused_braces)]
            $body
        })
    };
    ($format:literal, |$mcu:ident: &mut Mcu $(, $arg:ident: $t:ty)* $(,)?| $body:expr $(,)?) => {{
        $crate::command!(@agrees $format $(, $arg: $t)*);
        fn handler(
            $mcu: &mut $crate::mcu::Mcu,
            args: &mut $crate::protocol::vlq::Reader<'_>,
        ) -> Result<(), $crate::shutdown::Shutdown> {
            $(let $arg = <$t as $crate::protocol::format::Arg>::decode(args)?;)*
            let _ = args;
            $body
        }
        $crate::mcu::Command::new($format, handler)
    }};
    ($format:literal, $object:ty, |$own:ident, $context:tt $(, $arg:ident: $t:ty)* $(,)?| $body:expr $(,)?) => {{
        $crate::command!(@agrees $format, oid: $crate::mcu::Oid $(, $arg: $t)*);
        fn handler(
            mcu: &mut $crate::mcu::Mcu,
            args: &mut $crate::protocol::vlq::Reader<'_>,
        ) -> Result<(), $crate::shutdown::Shutdown> {
            let oid = <$crate::mcu::Oid as $crate::protocol::format::Arg>::decode(args)?;
            $(let $arg = <$t as $crate::protocol::format::Arg>::decode(args)?;)*
            mcu.context().with::<$object, _>(oid, |$own, $context| $body)
        }
        $crate::mcu::Command::new($format, handler)
    }};
    (@agrees $format:literal $(, $arg:ident: $t:ty)*) => {
        const {
            assert!(
                $crate::protocol::format::agrees($format, &[$($crate::protocol::format::Spec {
                    name: stringify!($arg),
                    conversions: <$t as $crate::protocol::format::Arg>::CONVERSIONS,
                }),*]),
                concat!("handler arguments disagree with \"", $format, "\"")
            )
        }
    };
}

/// Declares a response as a struct. The [`Hosts`] that use it follow the format, for example
/// `=> Hosts::of(&[V0_11, V0_12]);`. Without them, all hosts use it. The parent module must have a `response_index` that finds the format in the list of
/// responses ([`place_of_response`]). The build fails if the format is not listed.
#[macro_export]
macro_rules! response {
    ($(#[$doc:meta])* $format:literal $(=> $hosts:expr;)? $vis:vis struct $name:ident $(<$life:lifetime>)? {
        $($field:ident: $t:ty),* $(,)?
    }) => {
        $(#[$doc])*
        $vis struct $name $(<$life>)? { $(pub(crate) $field: $t),* }

        impl $(<$life>)? $crate::mcu::Response for $name $(<$life>)? {
            const FORM: $crate::mcu::Form = {
                assert!(
                    $crate::protocol::format::agrees($format, &[$($crate::protocol::format::Spec {
                        name: stringify!($field),
                        conversions: <$t as $crate::protocol::format::Field>::CONVERSIONS,
                    }),*]),
                    concat!("fields disagree with \"", $format, "\"")
                );
                // The given hosts, or else all.
                let hosts = [$($hosts,)? $crate::mcu::Hosts::ALL][0];
                $crate::mcu::Form { format: $format, hosts }
            };
            const INDEX: usize = super::response_index($format);
            fn encode(&self, writer: &mut $crate::protocol::vlq::Writer) {
                $($crate::protocol::format::Field::encode(&self.$field, writer);)*
                let _ = writer;
            }
        }
    };
}

/// The place of a response in the list of these features' responses. The compiler evaluates it. The build fails if no
/// feature lists the response.
pub const fn place_of_response(features: &[Feature], format: &str) -> usize {
    let mut index = 0;
    let mut feature = 0;
    while feature < features.len() {
        let responses = features[feature].responses;
        let mut response = 0;
        while response < responses.len() {
            if same(responses[response].format, format) {
                return index;
            }
            index += 1;
            response += 1;
        }
        feature += 1;
    }
    panic!("the response is not listed by any feature")
}
