//! The one place that knows the message codec: bincode 2.0.1, standard configuration.
//!
//! RUSTSEC-2025-0141 calls bincode unmaintained and 3.0.0 does not compile by design, so its name stays in this file.

use serde::Serialize;
use serde::de::DeserializeOwned;
use thiserror::Error;

/// Largest message that [`decode`] accepts and the most that decoding may allocate, bytes.
pub const MESSAGE_MAX_BYTES: usize = 256 * 1024;

/// Longest sample that [`decode_sample`] accepts, bytes. Larger values belong in the plain encoding, which needs no decoder.
pub const SAMPLE_MAX_BYTES: usize = 64 * 1024 * 1024;

/// A message that cannot be written or read.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum CodecError {
    /// The value holds something that the encoding cannot express.
    #[error("value cannot be encoded: {0}")]
    Encode(String),
    /// The bytes are not such a message.
    #[error("message cannot be decoded: {0}")]
    Decode(String),
    /// Bytes are left after the message.
    #[error("message has {0} bytes too many")]
    Trailing(usize),
    /// The message is longer than any may be.
    #[error("message of {0} bytes is longer than {MESSAGE_MAX_BYTES}")]
    TooLong(usize),
    /// The sample is longer than one in this encoding may be.
    #[error("sample of {0} bytes is longer than {SAMPLE_MAX_BYTES}")]
    SampleTooLong(usize),
}

/// Appends the encoding of `value` to `out`.
pub fn encode<T: Serialize>(value: &T, out: &mut Vec<u8>) -> Result<(), CodecError> {
    bincode::serde::encode_into_std_write(value, out, bincode::config::standard())
        .map(|_bytes| ())
        .map_err(|e| CodecError::Encode(e.to_string()))
}

/// Reads one value that takes up all of `bytes`. Claimed lengths cannot allocate more than [`MESSAGE_MAX_BYTES`].
pub fn decode<T: DeserializeOwned>(bytes: &[u8]) -> Result<T, CodecError> {
    if bytes.len() > MESSAGE_MAX_BYTES {
        return Err(CodecError::TooLong(bytes.len()));
    }
    let config = bincode::config::standard().with_limit::<MESSAGE_MAX_BYTES>();
    let (value, used) = bincode::serde::decode_from_slice(bytes, config)
        .map_err(|e| CodecError::Decode(e.to_string()))?;
    match bytes.len().saturating_sub(used) {
        0 => Ok(value),
        left => Err(CodecError::Trailing(left)),
    }
}

/// Reads one value from the head of `bytes` and says how many it took, for protocols that lay values end to end.
pub fn decode_prefix<T: DeserializeOwned>(bytes: &[u8]) -> Result<(T, usize), CodecError> {
    let config = bincode::config::standard().with_limit::<MESSAGE_MAX_BYTES>();
    bincode::serde::decode_from_slice(bytes, config).map_err(|e| CodecError::Decode(e.to_string()))
}

/// Reads one sample that takes up all of `bytes`, at most [`SAMPLE_MAX_BYTES`].
///
/// A lie about a length allocates at most 8 times what a message may, or what the largest sample may when the payload
/// itself is longer than a message: small integers take one byte each here and up to eight in memory.
pub fn decode_sample<T: DeserializeOwned>(bytes: &[u8]) -> Result<T, CodecError> {
    const SMALL: usize = MESSAGE_MAX_BYTES * 8;
    const LARGE: usize = SAMPLE_MAX_BYTES * 8;
    let standard = bincode::config::standard();
    let read = if bytes.len() <= MESSAGE_MAX_BYTES {
        bincode::serde::decode_from_slice(bytes, standard.with_limit::<SMALL>())
    } else if bytes.len() <= SAMPLE_MAX_BYTES {
        bincode::serde::decode_from_slice(bytes, standard.with_limit::<LARGE>())
    } else {
        return Err(CodecError::SampleTooLong(bytes.len()));
    };
    let (value, used) = read.map_err(|e| CodecError::Decode(e.to_string()))?;
    match bytes.len().saturating_sub(used) {
        0 => Ok(value),
        left => Err(CodecError::Trailing(left)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_what_it_writes_and_nothing_more() {
        let mut bytes = Vec::new();
        encode(&(7_u32, "seven".to_owned()), &mut bytes).unwrap();
        assert_eq!(
            decode::<(u32, String)>(&bytes).unwrap(),
            (7, "seven".to_owned())
        );
        bytes.push(0);
        assert!(matches!(
            decode::<(u32, String)>(&bytes),
            Err(CodecError::Trailing(1))
        ));
    }

    #[test]
    fn a_sample_may_be_longer_than_a_message() {
        let sample = vec![1_u64; MESSAGE_MAX_BYTES + 1];
        let mut bytes = Vec::new();
        encode(&sample, &mut bytes).unwrap();
        assert_eq!(decode_sample::<Vec<u64>>(&bytes).unwrap(), sample);
        assert!(matches!(
            decode::<Vec<u64>>(&bytes),
            Err(CodecError::TooLong(_))
        ));
        bytes.push(0);
        assert!(matches!(
            decode_sample::<Vec<u64>>(&bytes),
            Err(CodecError::Trailing(1))
        ));
    }

    #[test]
    fn a_lie_about_a_length_is_refused_before_it_allocates() {
        let lie = [253, 0, 0, 0, 0, 1, 0, 0, 0];
        assert!(matches!(
            decode::<Vec<u8>>(&lie),
            Err(CodecError::Decode(_))
        ));
    }
}
