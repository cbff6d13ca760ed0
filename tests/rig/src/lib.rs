//! The rig: a simulated network in one process and a laboratory of network namespaces.

pub mod lab;
pub mod sim;
