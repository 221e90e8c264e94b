// SPDX-License-Identifier: GPL-3.0-or-later
//! The data dictionary (docs/Protocol.md, "Data dictionary"). klippy reads it through `identify`. Its batch mode reads
//! it from a file (`-d`).

use std::io::{self, Read, Write};

use flate2::Compression;
use flate2::read::ZlibDecoder;
use flate2::write::ZlibEncoder;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

/// Longest JSON that is read, in bytes. Klipper's has some 30,000.
const JSON_MAX: u64 = 4 << 20;

/// The id of `identify_response`. Every host knows it.
pub const IDENTIFY_RESPONSE_ID: i32 = 0;
/// The id of `identify`. Every host knows it.
pub const IDENTIFY_ID: i32 = 1;

/// The dictionary's contents. Maps keep the order in which they are written.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Dictionary {
    /// The program's name. Hosts up to v0.12 do not know this entry.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub app: String,
    /// The tools that built it.
    #[serde(default)]
    pub build_versions: String,
    /// The id of each command, by format.
    pub commands: Map<String, Value>,
    /// The constants.
    pub config: Map<String, Value>,
    /// Names of values. A value is a number, or `[first, count]` for a run of names.
    pub enumerations: Map<String, Value>,
    /// The license. Hosts up to v0.12 do not know this entry.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub license: String,
    /// The id of each response, by format.
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

    /// The dictionary's JSON, as klippy reads it with `-d`.
    pub fn json(&self) -> io::Result<Vec<u8>> {
        Ok(serde_json::to_vec(self)?)
    }

    /// Reads a dictionary from the data of `identify`.
    ///
    /// # Errors
    ///
    /// It is no dictionary, or its JSON has over 4 MiB. A few bytes can be the compressed form of many.
    pub fn decompress(bytes: &[u8]) -> io::Result<Dictionary> {
        let mut json = Vec::new();
        ZlibDecoder::new(bytes).take(JSON_MAX + 1).read_to_end(&mut json)?;
        if json.len() as u64 > JSON_MAX {
            return Err(io::Error::other(format!("its JSON has over {JSON_MAX} bytes")));
        }
        Ok(serde_json::from_slice(&json)?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn dictionary() -> Dictionary {
        let of = |key: &str, value: Value| Map::from_iter([(key.to_owned(), value)]);
        Dictionary {
            app: "Pinion".into(),
            commands: of("identify offset=%u count=%c", IDENTIFY_ID.into()),
            enumerations: of("pin", vec![0, 8].into()),
            responses: of("identify_response offset=%u data=%.*s", IDENTIFY_RESPONSE_ID.into()),
            ..Dictionary::default()
        }
    }

    fn compressed(json: &[u8]) -> Vec<u8> {
        let mut encoder = ZlibEncoder::new(Vec::new(), Compression::best());
        encoder.write_all(json).unwrap();
        encoder.finish().unwrap()
    }

    #[test]
    fn a_dictionary_comes_back_from_its_compressed_form() {
        let json = dictionary().json().unwrap();
        let compressed = dictionary().compress().unwrap();
        assert!(compressed.len() < json.len());
        assert_eq!(Dictionary::decompress(&compressed).unwrap().json().unwrap(), json);
        assert_eq!(
            String::from_utf8(json).unwrap(),
            r#"{"app":"Pinion","build_versions":"","commands":{"identify offset=%u count=%c":1},"config":{},"enumerations":{"pin":[0,8]},"responses":{"identify_response offset=%u data=%.*s":0},"version":""}"#
        );
    }

    #[test]
    fn a_dictionary_over_4_mib_is_refused() {
        let mut json = dictionary().json().unwrap();
        json.resize(4 << 20, b' ');
        assert!(Dictionary::decompress(&compressed(&json)).is_ok());
        json.push(b' ');
        let compressed = compressed(&json);
        assert!(compressed.len() < 10_000);
        let error = Dictionary::decompress(&compressed).unwrap_err();
        assert_eq!(error.to_string(), "its JSON has over 4194304 bytes");
    }
}
