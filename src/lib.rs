//! Where the rooms meet the operating system: the daemon of one host, and the command line.

pub mod cli;
pub mod config;
mod data;
pub mod error;
pub mod host;
mod identity;
mod manager;
mod net;
mod source;
pub mod units;
mod video;
