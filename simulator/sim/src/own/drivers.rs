// SPDX-License-Identifier: GPL-3.0-or-later
//! Stepper drivers with a bus.

use pinion_model::{Tmc2209Config, Tmc5160Config};
use pinion_printer_config::{Section, Trouble};

use super::description::Entry;
use super::known::motor_of;
use super::translator::Translator;

/// Highest address of a driver on a UART.
const ADDRESS_MAX: i64 = 3;

impl Translator<'_> {
    pub(super) fn drivers(&mut self) -> Result<(), Trouble> {
        for section in self.config.sections() {
            match section.kind() {
                kind @ ("tmc2130" | "tmc2660" | "tmc5160" | "tmc2240") if section.text("uart_pin").is_none() => {
                    self.by_spi(section, kind)?;
                }
                kind @ ("tmc2208" | "tmc2209" | "tmc2240") => self.by_uart(section, kind)?,
                _ => {}
            }
        }
        Ok(())
    }

    /// The axis of a driver's motor. `None` if the kinematics do not use the motor.
    fn driven(&self, section: &Section) -> Option<String> {
        self.axes.get(motor_of(section)).cloned()
    }

    /// The pin at which a driver says that its motor stalls. The level is the chip's: a `!` too many or too few shows.
    fn take_diag(&mut self, section: &Section, key: &str) -> Result<Option<String>, Trouble> {
        Ok(self.take(section, key)?.map(|pin| pin.trim_start_matches('!').to_owned()))
    }

    fn by_spi(&mut self, section: &Section, kind: &str) -> Result<(), Trouble> {
        let Some(axis) = self.driven(section).filter(|axis| self.out.is_new_driver(axis)) else { return Ok(()) };
        section.required("cs_pin")?;
        let chain = section.whole("chain_length", 2)?;
        // klippy opens the bus of a chain for the first of its drivers.
        let config = self.config;
        let first = config.of_kind(kind).find(|other| other.text("cs_pin") == section.text("cs_pin"));
        let Some((bus, select)) = self.spi(first.filter(|_| chain.is_some()).unwrap_or(section), "cs_pin")? else {
            return Ok(());
        };
        let mut part = Entry::of_kind(kind).set("axis", axis).set("bus", bus);
        part = match chain {
            Some(length) => {
                section.required("chain_position")?;
                let place = section.whole("chain_position", 1)?.unwrap_or(1);
                let pin = self.pin(section, "cs_pin")?.map(|pin| pin.to_string());
                part.set_if("select_pin", pin).set("chain_position", place).set("chain_length", length)
            }
            None => part.set_if("select_pin", select),
        };
        if kind != "tmc2660" {
            part = self.with_stall_guard(section, part)?;
        }
        self.out.add("part", part);
        Ok(())
    }

    /// The outputs that report a stall, and the load that suits the sensitivity that the motor's owner found.
    fn with_stall_guard(&mut self, section: &Section, part: Entry) -> Result<Entry, Trouble> {
        let mut part = part;
        if let Some(sgt) = section.whole("driver_sgt", -64)? {
            part = part.set("sg_free", Tmc5160Config::free_with_sgt(sgt.min(63) as i32));
        }
        for key in ["diag0_pin", "diag1_pin"] {
            part = part.set_if(key, self.take_diag(section, key)?);
        }
        Ok(part)
    }

    fn by_uart(&mut self, section: &Section, kind: &str) -> Result<(), Trouble> {
        let Some(axis) = self.driven(section).filter(|axis| self.out.is_new_driver(axis)) else { return Ok(()) };
        section.required("uart_pin")?;
        let Some(pin) = self.pin(section, "uart_pin")?.filter(|pin| self.is_real(pin)) else { return Ok(()) };
        self.take_pin(section, &pin);
        // The description has another kind of a TMC2240 on SPI.
        let part = if kind == "tmc2240" { "tmc2240_uart" } else { kind };
        let mut part = Entry::of_kind(part).set("axis", axis).set("uart_pin", pin.to_string());
        let mut selects: Vec<toml::Value> = Vec::new();
        for text in section.list("select_pins", ',') {
            let select = self.pin_of(section, "select_pins", text)?;
            // The drivers of a multiplexer share its lines.
            self.take_pin(section, &select);
            selects.push(select.to_string().into());
        }
        if !selects.is_empty() {
            part = part.set("select_pins", selects);
        }
        if let Some(tx) = self.pin(section, "tx_pin")?.filter(|pin| self.is_real(pin)) {
            self.take_pin(section, &tx);
            part = part.set("tx_pin", tx.to_string());
        }
        if kind != "tmc2208" {
            let address = section.whole("uart_address", 0)?.unwrap_or(0);
            if address > ADDRESS_MAX {
                let cause = format!("Option 'uart_address' in section '{}' must have maximum of 3", section.name);
                return Err(section.trouble("uart_address", cause).remedy("correct its value"));
            }
            part = part.set("address", address);
        }
        if kind == "tmc2240" {
            part = self.with_stall_guard(section, part)?;
        }
        if kind == "tmc2209" {
            part = part.set_if("diag_pin", self.take_diag(section, "diag_pin")?);
            if let Some(threshold) = section.whole("driver_sgthrs", 0)? {
                part = part.set("sg_free", Tmc2209Config::free_with_sgthrs(threshold.min(255) as u32));
            }
        }
        self.out.add("part", part);
        Ok(())
    }
}
