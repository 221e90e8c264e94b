// SPDX-License-Identifier: GPL-3.0-or-later
//! A micro-controller's dictionary, as the client reads it: compressed, or its JSON. A line with a command and bytes of
//! a response may follow it; a byte 0 separates them.

use std::time::Instant;

use pinion_client::messages::Messages;
use pinion_client::serial::Received;
use pinion_protocol::block::PAYLOAD_MAX;
use pinion_protocol::dictionary::Dictionary;

pub fn run(bytes: &[u8]) {
    let _ = Dictionary::decompress(bytes);
    let mut parts = bytes.splitn(3, |byte| *byte == 0);
    let mut part = || parts.next().unwrap_or_default();
    let Ok(dictionary) = serde_json::from_slice::<Dictionary>(part()) else { return };
    let compressed = dictionary.compress().expect("a dictionary is JSON");
    let again = Dictionary::decompress(&compressed).expect("it was just compressed");
    assert_eq!(again.json().ok(), dictionary.json().ok());
    let messages = Messages::new(&dictionary);
    if let Ok(payload) = messages.encode_line(&String::from_utf8_lossy(part())) {
        assert!(payload.len() <= PAYLOAD_MAX);
    }
    messages.decode(&Received { payload: part().to_vec(), at: Instant::now() });
}
