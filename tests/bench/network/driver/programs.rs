//! The contenders whose programs are in here: ddx itself, and the floor.

pub(crate) mod ddx;
pub(crate) mod udp;
