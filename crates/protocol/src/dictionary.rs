// SPDX-License-Identifier: GPL-3.0-or-later
//! The data dictionary: what klippy reads through `identify`, and what its batch mode takes
//! with `-d` (docs/Protocol.md, "Data dictionary").

#![forbid(unsafe_code)]

use std::io::{self, Read, Write};

use flate2::Compression;
use flate2::read::ZlibDecoder;
use flate2::write::ZlibEncoder;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

/// The id of `identify_response`, which a host knows beforehand.
pub const IDENTIFY_RESPONSE_ID: i32 = 0;
/// The id of `identify`, which a host knows beforehand.
pub const IDENTIFY_ID: i32 = 1;

/// The dictionary's contents; maps keep the order in which they are written.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Dictionary {
    /// The program that speaks. Hosts up to v0.12 do not know this entry.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub app: String,
    /// What it was built with.
    #[serde(default)]
    pub build_versions: String,
    /// Id of each command by format.
    pub commands: Map<String, Value>,
    /// The constants.
    pub config: Map<String, Value>,
    /// Names for values: a number, or `[first, count]` for a run of names.
    pub enumerations: Map<String, Value>,
    /// The licence; as `app`.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub license: String,
    /// Id of each response by format.
    pub responses: Map<String, Value>,
    /// The program's version.
    #[serde(default)]
    pub version: String,
}

impl Dictionary {
    /// The dictionary's JSON, compressed by zlib as `identify` serves it.
    pub fn compress(&self) -> io::Result<Vec<u8>> {
        let mut encoder = ZlibEncoder::new(Vec::new(), Compression::best());
        encoder.write_all(&self.json()?)?;
        encoder.finish()
    }

    /// The dictionary's JSON, as klippy takes it with `-d`.
    pub fn json(&self) -> io::Result<Vec<u8>> {
        Ok(serde_json::to_vec(self)?)
    }

    /// Reads what `identify` served.
    pub fn decompress(bytes: &[u8]) -> io::Result<Dictionary> {
        let mut json = Vec::new();
        ZlibDecoder::new(bytes).read_to_end(&mut json)?;
        Ok(serde_json::from_slice(&json)?)
    }
}
