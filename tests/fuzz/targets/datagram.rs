//! Any datagrams from anybody, members with the key included.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| ddx_fuzz::datagram::run(data));
