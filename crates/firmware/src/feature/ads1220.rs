// SPDX-License-Identifier: GPL-3.0-or-later
//! The ADC ADS1220 on SPI, for load cells (Texas Instruments SBAS501).
//!
//! After DRDY goes low, 24 clocks shift out a sample: 24 bits in two's complement, the highest bit first ("Data
//! Format"). klippy itself sets up the chip.

use crate::board::Pin;
use crate::mcu::DialectName::{Kalico, Master, V0_13};
use crate::mcu::{Command, Context, Feature, JobSlot, Oid, command};
use crate::shutdown::Shutdown;
use crate::time::Ticks;

use super::ready_adc::{Frame, ReadyAdc, ReadyChip, Sample, configure_spi, signed_24};
use super::spi::spi_shutdown;
use crate::board::BusError;

pub(super) const FEATURE: Feature = Feature {
    serves: "ADS1220 load cells",

    commands: &[
        CONFIG_ADS1220,
        ADS1220_ATTACH_TRIGGER_ANALOG,
        ADS1220_ATTACH_LOAD_CELL_PROBE,
        QUERY_ADS1220,
        QUERY_ADS1220_STATUS,
    ],
    ..Feature::EMPTY
};

const SAMPLE_BYTES: usize = 3;

struct Ads1220 {
    spi: Oid,
}

impl ReadyChip for Ads1220 {
    const NAME: &'static str = "ADS1220";
    type Reading = Frame<SAMPLE_BYTES>;

    fn read(&mut self, context: &mut Context, reading: &mut JobSlot<Self::Reading>) -> Result<(), Shutdown> {
        reading.send_to(context, self.spi)
    }

    fn stop(failure: &BusError) -> Shutdown {
        spi_shutdown(failure.clone())
    }

    fn sample(&mut self, frame: Frame<SAMPLE_BYTES>, _late: bool) -> Sample {
        Sample::Value(frame.received().first_chunk().map_or(0, |bytes| signed_24(*bytes)))
    }
}

type Sensor = ReadyAdc<Ads1220>;

const CONFIG_ADS1220: Command = command!(
    "config_ads1220 oid=%c spi_oid=%c data_ready_pin=%u",
    |context, oid: Oid, spi_oid: Oid, data_ready_pin: Pin| {
        configure_spi(context, oid, (spi_oid, data_ready_pin), Ads1220 { spi: spi_oid }, SAMPLE_BYTES)
    }
)
.of(&[V0_13, Master, Kalico]);

const ADS1220_ATTACH_TRIGGER_ANALOG: Command = command!(
    "ads1220_attach_trigger_analog oid=%c trigger_analog_oid=%c",
    Sensor,
    |sensor, context, trigger_analog_oid: Oid| { sensor.attached.attach(context, trigger_analog_oid) }
)
.of(&[Master]);

const ADS1220_ATTACH_LOAD_CELL_PROBE: Command = command!(
    "ads1220_attach_load_cell_probe oid=%c load_cell_probe_oid=%c",
    Sensor,
    |sensor, context, load_cell_probe_oid: Oid| sensor.attached.attach_probe(context, load_cell_probe_oid)
)
.of(&[Kalico]);

const QUERY_ADS1220: Command =
    command!("query_ads1220 oid=%c rest_ticks=%u", Sensor, |sensor, context, rest_ticks: Ticks| {
        sensor.query(context, rest_ticks)
    })
    .of(&[V0_13, Master, Kalico]);

const QUERY_ADS1220_STATUS: Command = command!("query_ads1220_status oid=%c", Sensor, |sensor, context| sensor
    .query_status(context))
.of(&[V0_13, Master, Kalico]);

#[cfg(test)]
mod tests {
    use super::*;

    /// "Ideal Output Code versus Input Signal" of the data sheet.
    #[test]
    fn codes_are_those_of_the_data_sheet() {
        for (bytes, value) in [
            ([0x7f, 0xff, 0xff], 8_388_607),
            ([0x00, 0x00, 0x01], 1),
            ([0x00, 0x00, 0x00], 0),
            ([0xff, 0xff, 0xff], -1),
            ([0x80, 0x00, 0x00], -8_388_608),
        ] {
            assert_eq!(signed_24(bytes), value, "{bytes:02x?}");
        }
    }
}
