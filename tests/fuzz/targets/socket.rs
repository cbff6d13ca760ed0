//! Any messages and descriptors from the programs of a host.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| ddx_fuzz::socket::run(data));
