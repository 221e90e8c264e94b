// SPDX-License-Identifier: GPL-3.0-or-later
//! Configures an MCU as klippy does: oids, config commands, their checksum. It also resets an MCU that is configured or
//! shut down.

use std::time::{Duration, Instant};

use flate2::Crc;

use super::{Client, Error};

/// Timeout for a reset, and for the answer to an emergency stop.
const RESET_TIMEOUT: Duration = Duration::from_secs(60);
/// klippy's pause between the steps of a reset.
const RESET_PAUSE: Duration = Duration::from_millis(15);

/// A configuration in preparation: commands in klippy's notation, without `allocate_oids` and `finalize_config`. Those
/// two are added at the end.
#[derive(Clone, Debug, Default)]
pub struct Config {
    oids: u8,
    commands: Vec<String>,
}

/// The answer to `get_config`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Status {
    /// Whether it is configured.
    pub is_config: bool,
    /// The checksum of its configuration.
    pub crc: u32,
    /// Whether it is shut down.
    pub is_shutdown: bool,
    /// Entries of its move queue.
    pub move_count: u16,
}

impl Config {
    /// The next object's id. Fails after 255 of them.
    pub fn oid(&mut self) -> Result<u8, Error> {
        let oid = self.oids;
        self.oids = oid.checked_add(1).ok_or_else(|| Error::Plan {
            subject: "configuration".to_owned(),
            why: "it has more than 255 objects: leave some out".to_owned(),
        })?;
        Ok(oid)
    }

    /// Appends a command.
    pub fn add(&mut self, command: String) {
        self.commands.push(command);
    }

    /// All commands except the last, `finalize_config`, in order.
    pub fn lines(&self) -> Vec<String> {
        let mut lines = vec![format!("allocate_oids count={}", self.oids)];
        lines.extend_from_slice(&self.commands);
        lines
    }

    /// The checksum: CRC-32 of the lines.
    pub fn crc(&self) -> u32 {
        let mut crc = Crc::new();
        crc.update(self.lines().join("\n").as_bytes());
        crc.sum()
    }

    /// Configures an MCU. Resets it first if it is configured or shut down. Fails if it shuts down because of a command
    /// (for example for a pin in use).
    pub fn apply(&self, client: &mut Client) -> Result<Status, Error> {
        let status = client.status()?;
        if status.is_config || status.is_shutdown {
            client.reset()?;
        }
        for line in self.lines() {
            client.send_line(&line)?;
        }
        client.send("finalize_config", &[("crc", self.crc().into())])?;
        client.link().settle()?;
        let status = client.status()?;
        client.check()?;
        if !status.is_config || status.crc != self.crc() {
            return Err(Error::Plan {
                subject: "configuration".to_owned(),
                why: "the MCU did not accept it: stop any other host on its tty".to_owned(),
            });
        }
        Ok(status)
    }
}

impl Client {
    /// Queries the state of the configuration.
    pub fn status(&mut self) -> Result<Status, Error> {
        let config = match self.query("get_config", &[], "config", None) {
            // The query fails if the report of a shutdown arrives during it. A stopped MCU still answers get_config, so
            // ask once more.
            Err(Error::Shutdown { .. }) => self.query("get_config", &[], "config", None)?,
            other => other?,
        };
        Ok(Status {
            is_config: config.flag("is_config")?,
            crc: config.u32("crc")?,
            is_shutdown: config.flag("is_shutdown")?,
            move_count: config.u32("move_count")? as u16,
        })
    }

    /// Shuts the MCU down. Returns its reason; `None` if it gives none within a minute.
    pub fn emergency_stop(&mut self) -> Result<Option<String>, Error> {
        self.send("emergency_stop", &[])?;
        self.wait_shutdown(RESET_TIMEOUT)
    }

    /// Resets the MCU as klippy's FIRMWARE_RESTART does: `emergency_stop`, `config_reset`, a new session. (`reset` if
    /// there is no `config_reset`.)
    pub fn reset(&mut self) -> Result<(), Error> {
        let command =
            ["config_reset", "reset"].into_iter().find(|name| self.messages().has_command(name)).ok_or_else(|| {
                Error::Plan { subject: "reset".to_owned(), why: "the MCU has no reset command: restart it".to_owned() }
            })?;
        let until = Instant::now() + RESET_TIMEOUT;
        self.emergency_stop()?;
        std::thread::sleep(RESET_PAUSE);
        self.send(command, &[])?;
        std::thread::sleep(RESET_PAUSE);
        // The C program restarts itself and closes the tty. Its output before that is dropped.
        loop {
            let rest = until.saturating_duration_since(Instant::now());
            let attempt = self.reconnect(rest).and_then(|()| self.status());
            match attempt {
                Ok(status) if !status.is_config && !status.is_shutdown => {
                    self.forget_shutdown();
                    return Ok(());
                }
                Err(error) if Instant::now() >= until => return Err(error),
                Ok(_) if Instant::now() >= until => {
                    return Err(Error::Timeout {
                        waiting_for: "end of the MCU's reset".to_owned(),
                        after: RESET_TIMEOUT,
                    });
                }
                Ok(_) | Err(_) => std::thread::sleep(RESET_PAUSE),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::fake::FakeMcu;
    use super::*;

    #[test]
    fn the_check_sum_is_klippy_s() {
        let mut config = Config::default();
        let oid = config.oid().unwrap();
        config.add(format!("config_trsync oid={oid}"));
        // zlib.crc32(b"allocate_oids count=1\nconfig_trsync oid=0")
        assert_eq!(config.crc(), 0x9519a596);
    }

    #[test]
    fn an_mcu_is_configured_and_one_in_use_is_reset_first() {
        let (peer, link) = FakeMcu::default().start();
        let mut client = Client::new(link).unwrap();
        let mut config = Config::default();
        for crc in 0..2 {
            let oid = config.oid().unwrap();
            config.add(format!("config_endstop oid={oid} pin=gpio{crc} pull_up=0"));
            let status = config.apply(&mut client).unwrap();
            assert!(status.is_config && !status.is_shutdown);
            assert_eq!((status.crc, status.move_count), (config.crc(), 1024));
        }
        client.emergency_stop().unwrap();
        config.apply(&mut client).unwrap();
        client.check().unwrap();
        drop(client);
        peer.join().unwrap();
    }

    #[test]
    fn more_objects_than_oids_are_refused() {
        let mut config = Config::default();
        let given = std::iter::from_fn(|| config.oid().ok()).count();
        assert_eq!(given, 255);
    }
}
