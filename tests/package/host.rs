// SPDX-License-Identifier: GPL-3.0-or-later
//! A host in the booted system. The checks start it as klippy's user:
//!
//! ```text
//! host identify LINK [PIN]   prints the version, and fails if there is no such pin
//! host light LINK PIN        switches a heater on, prints "lit" and refreshes it until it is killed
//! host open LINK BUS         has the MCU open this I2C bus
//! host home LINK             homes an axis until the endstop, which the check closes, triggers
//! host ask SOCKET METHOD PARAMS POINTER
//!                            asks klippy over its API socket (docs/API_Server.md of Klipper), and prints
//!                            what the JSON pointer leads to in the result
//! ```

use std::io::{self, Read, Write};
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use pinion_client::config::Config;
use pinion_client::motion::{Endstop, HomingEnd, MoveQueue, Profile, Stepper};
use pinion_client::{Client, Error};
use serde_json::{Value, json};

/// Timeout of the client.
const CLIENT_TIMEOUT: Duration = Duration::from_secs(10);
/// How long a heater may stay without a refresh before the MCU shuts down.
const MAX_DURATION_S: f64 = 3.0;
const REFRESH: Duration = Duration::from_millis(300);
/// Timeout of the host. It answers G-code when the G-code has ended, and an emulated computer homes slowly.
const HOST_TIMEOUT: Duration = Duration::from_secs(120);

fn main() -> ExitCode {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let args: Vec<&str> = args.iter().map(String::as_str).collect();
    let done = match args[..] {
        ["identify", link] => identify(link, None),
        ["identify", link, pin] => identify(link, Some(pin)),
        ["light", link, pin] => light(link, pin),
        ["open", link, bus] => open(link, bus),
        ["home", link] => home(link),
        ["ask", socket, method, params, pointer] => return asked(ask(socket, method, params, pointer)),
        // cargo and similar programs may start it in this way.
        _ => return ExitCode::SUCCESS,
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("host: {error}");
            ExitCode::FAILURE
        }
    }
}

fn connect(link: &str) -> Result<Client, Error> {
    Client::connect(Path::new(link), CLIENT_TIMEOUT)
}

fn identify(link: &str, pin: Option<&str>) -> Result<(), Error> {
    let client = connect(link)?;
    println!("version {}", client.dictionary().version);
    let pins = client.dictionary().enumerations.get("pin").and_then(Value::as_object);
    match pin {
        Some(pin) if !pins.is_some_and(|pins| pins.contains_key(pin)) => {
            Err(Error::Plan { subject: pin.to_owned(), why: "the dictionary has no such pin".to_owned() })
        }
        _ => Ok(()),
    }
}

fn light(link: &str, pin: &str) -> Result<(), Error> {
    let mut client = connect(link)?;
    let mut config = Config::default();
    let oid = config.oid()?;
    let longest = client.ticks(MAX_DURATION_S);
    config.add(format!("config_digital_out oid={oid} pin={pin} value=0 default_value=0 max_duration={longest}"));
    config.apply(&mut client)?;
    for round in 0.. {
        client.send_line(&format!("update_digital_out oid={oid} value=1"))?;
        client.status()?;
        client.check()?;
        if round == 0 {
            println!("lit");
        }
        client.listen(Instant::now() + REFRESH)?;
    }
    Ok(())
}

fn open(link: &str, bus: &str) -> Result<(), Error> {
    let mut client = connect(link)?;
    let mut config = Config::default();
    let oid = config.oid()?;
    config.add(format!("config_i2c oid={oid}"));
    config.add(format!("i2c_set_bus oid={oid} i2c_bus={bus} rate=100000 address=80"));
    config.apply(&mut client)?;
    Ok(())
}

fn home(link: &str) -> Result<(), Error> {
    let mut client = connect(link)?;
    let mut config = Config::default();
    let pulse = client.ticks(0.000_002);
    let stepper = Stepper::configure(&mut config, "STEP", 0, "DIR", false, pulse)?;
    let endstop = Endstop::configure(&mut config, "ENDSTOP", 0, false)?;
    let status = config.apply(&mut client)?;
    // A move of ten seconds. The check closes the endstop after one second.
    let profile = Profile::trapezoid(1000, 100.0, 400.0, client.frequency_hz())?;
    println!("homing");
    let homed = MoveQueue::new(status.move_count).home(&mut client, stepper, endstop, true, &profile, &mut |_| ())?;
    println!("homed at {} by {:?}", homed.position, homed.reason);
    match homed.reason {
        HomingEnd::Endstop if homed.position > 0 => Ok(()),
        _ => Err(Error::Plan { subject: "homing".to_owned(), why: "not ended by the endstop".to_owned() }),
    }
}

fn asked(answer: Result<String, String>) -> ExitCode {
    match answer {
        Ok(answer) => {
            println!("{answer}");
            ExitCode::SUCCESS
        }
        Err(error) => {
            eprintln!("{error}");
            ExitCode::FAILURE
        }
    }
}

/// The error is klippy's own text, if there is one.
fn ask(socket: &str, method: &str, params: &str, pointer: &str) -> Result<String, String> {
    let params: Value = serde_json::from_str(params).map_err(|error| format!("{params}: {error}"))?;
    let answer = request(socket, &json!({ "id": 1, "method": method, "params": params }))
        .map_err(|error| format!("{socket}: {error}"))?;
    if let Some(error) = answer.get("error") {
        return Err(error["message"].as_str().map_or_else(|| error.to_string(), str::to_owned));
    }
    match answer["result"].pointer(pointer) {
        Some(Value::String(text)) => Ok(text.clone()),
        Some(value) => Ok(value.to_string()),
        None => Err(format!("{answer} has no {pointer}")),
    }
}

fn request(socket: &str, request: &Value) -> io::Result<Value> {
    let mut api = UnixStream::connect(socket)?;
    api.set_read_timeout(Some(HOST_TIMEOUT))?;
    api.write_all(format!("{request}\x03").as_bytes())?;
    let mut answer = Vec::new();
    for byte in api.bytes() {
        match byte? {
            b'\x03' => return Ok(serde_json::from_slice(&answer)?),
            byte => answer.push(byte),
        }
    }
    Err(io::Error::other("klippy has hung up"))
}
