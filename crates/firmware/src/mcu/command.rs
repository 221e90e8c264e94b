// SPDX-License-Identifier: GPL-3.0-or-later
//! Declarations: a command's or response's format, its typed parameters and its handler stand
//! together, and a disagreement between them is a build error.

#![forbid(unsafe_code)]

use crate::board::{Board, Range};
use crate::shutdown::{Shutdown, ShutdownReason, reason};
use pinion_protocol::Malformed;
use pinion_protocol::format::same;
use pinion_protocol::vlq::{Reader, Writer};

use super::{Generations, Mcu};

impl From<Malformed> for Shutdown {
    /// The cause is empty: [`Mcu::execute`] adds which command it was.
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
    /// The hosts that take it in this form.
    pub generations: Generations,
    /// Whether it also runs after a shutdown.
    pub in_shutdown: bool,
    /// Whether it may join its own kind: see [`Command::joining`].
    pub joins: bool,
    /// What it does.
    pub handler: Handler,
}

impl Command {
    /// A command that all hosts take, while the MCU runs. [`command!`](crate::command) declares one.
    pub const fn new(format: &'static str, handler: Handler) -> Command {
        Command { format, generations: Generations::ALL, in_shutdown: false, joins: false, handler }
    }

    /// Lets the command run after a shutdown too (`HF_IN_SHUTDOWN`).
    pub const fn allowed_in_shutdown(mut self) -> Command {
        self.in_shutdown = true;
        self
    }

    /// Lets the command run while commands wait for the errand of one like it that its object
    /// [lets others join](super::Turn::let_join). Its first parameter must be the oid.
    pub const fn joining(mut self) -> Command {
        self.joins = true;
        self
    }

    /// The hosts that take this form: [`since`](super::since), [`until`](super::until) or
    /// [`only`](super::only). Without it, all do.
    pub const fn of(mut self, generations: Generations) -> Command {
        self.generations = generations;
        self
    }
}

/// A form of a response: what the dictionary has of it.
pub struct Form {
    /// Name, parameters and their conversions.
    pub format: &'static str,
    /// The hosts that take it in this form.
    pub generations: Generations,
}

/// A message to the host.
pub trait Response {
    /// Its format, and the hosts that take it.
    const FORM: Form;
    /// Its place in the list of the responses of all features.
    const INDEX: usize;
    /// Appends the parameters.
    fn encode(&self, writer: &mut Writer);
}

/// A constant of the dictionary.
pub struct Constant {
    /// Such as `ADC_MAX`.
    pub name: &'static str,
    /// What it stands for.
    pub value: ConstantValue,
    /// The hosts that have it.
    pub generations: Generations,
}

/// What a constant stands for.
pub enum ConstantValue {
    /// A number.
    Number(u32),
    /// A text.
    Text(&'static str),
}

impl Constant {
    /// A constant that is a number.
    pub const fn number(name: &'static str, number: u32) -> Constant {
        Constant { name, value: ConstantValue::Number(number), generations: Generations::ALL }
    }

    /// A constant that is a text.
    pub const fn text(name: &'static str, text: &'static str) -> Constant {
        Constant { name, value: ConstantValue::Text(text), generations: Generations::ALL }
    }

    /// The hosts that have it; without this, all do.
    pub const fn of(mut self, generations: Generations) -> Constant {
        self.generations = generations;
        self
    }
}

/// An enumeration of the dictionary. Its names may depend on the board.
pub struct Enumeration {
    /// Such as `spi_bus`.
    pub name: &'static str,
    /// The names on this board, and the values that they stand for.
    pub values: fn(&dyn Board) -> Vec<Range>,
    /// The hosts that have it.
    pub generations: Generations,
}

impl Enumeration {
    /// An enumeration.
    pub const fn new(name: &'static str, values: fn(&dyn Board) -> Vec<Range>) -> Enumeration {
        Enumeration { name, values, generations: Generations::ALL }
    }

    /// The hosts that have it with these values; without this, all do.
    pub const fn of(mut self, generations: Generations) -> Enumeration {
        self.generations = generations;
        self
    }
}

/// What a feature adds to the dictionary. Fields that a feature does not need come from
/// [`Feature::EMPTY`].
pub struct Feature {
    /// Its name.
    pub name: &'static str,
    /// Its commands.
    pub commands: &'static [Command],
    /// Its responses.
    pub responses: &'static [Form],
    /// Its constants.
    pub constants: &'static [Constant],
    /// Its enumerations.
    pub enumerations: &'static [Enumeration],
    /// Its shutdown texts: the `SHUTDOWNS` that [`shutdowns!`](crate::shutdown::shutdowns) makes.
    pub shutdowns: &'static [ShutdownReason],
}

impl Feature {
    /// A feature that adds nothing.
    pub const EMPTY: Feature =
        Feature { name: "", commands: &[], responses: &[], constants: &[], enumerations: &[], shutdowns: &[] };
}

/// Declares a command: its format, and a closure with the MCU and the typed parameters.
///
/// A command to an object names the object's type behind the format. Its first parameter is the object's `oid`, and its
/// closure has the object and its [`Turn`](crate::mcu::Turn) in place of the MCU and the oid.
#[macro_export]
macro_rules! command {
    ($format:literal, |$mcu:ident $(, $arg:ident: $t:ty)* $(,)?| $body:expr $(,)?) => {{
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
    ($format:literal, $object:ty, |$own:ident, $turn:tt $(, $arg:ident: $t:ty)* $(,)?| $body:expr $(,)?) => {{
        $crate::command!(@agrees $format, oid: $crate::mcu::Oid $(, $arg: $t)*);
        fn handler(
            mcu: &mut $crate::mcu::Mcu,
            args: &mut $crate::protocol::vlq::Reader<'_>,
        ) -> Result<(), $crate::shutdown::Shutdown> {
            let oid = <$crate::mcu::Oid as $crate::protocol::format::Arg>::decode(args)?;
            $(let $arg = <$t as $crate::protocol::format::Arg>::decode(args)?;)*
            mcu.with::<$object, _>(oid, |$own, $turn| $body)
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

/// Declares a response as a struct. Behind the format stands which hosts take it, such as
/// `=> until(V0_12);`; without it, all do. The module above must have a `response_index`, which finds
/// its format in the list of responses ([`place_of_response`]); one that is not listed is a
/// build error.
#[macro_export]
macro_rules! response {
    ($(#[$doc:meta])* $format:literal $(=> $generations:expr;)? $vis:vis struct $name:ident $(<$life:lifetime>)? {
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
                // What was said, or else all.
                let generations = [$($generations,)? $crate::mcu::Generations::ALL][0];
                $crate::mcu::Form { format: $format, generations }
            };
            const INDEX: usize = super::response_index($format);
            fn encode(&self, writer: &mut $crate::protocol::vlq::Writer) {
                $($crate::protocol::format::Field::encode(&self.$field, writer);)*
                let _ = writer;
            }
        }
    };
}

/// The place of a response in the list of all that these features send. Evaluated by the compiler, it fails the build
/// if no feature lists the response.
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
