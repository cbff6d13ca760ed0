//! What strangers can say to a host, said at random: the plays behind the two fuzz targets.
//!
//! An input is a play: one byte says what happens next, the bytes after it how. The first nine tenths of the code that
//! hostile input reaches lie behind a seal or a checked segment, so the plays hold the key and make the segments: the
//! fuzzer chooses who speaks, what is true of what they say, and when. `tests/fuzz/run` drives them; `cargo run --bin
//! seeds` writes the plays that it starts from.

pub mod datagram;
mod input;
pub mod socket;

pub use input::Input;
