//! The rig: a simulated network in one process and a laboratory of network namespaces, and the one link emulator
//! of both.

pub mod lab;
pub mod link;
mod random;
pub mod sim;
