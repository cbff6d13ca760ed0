//! What the real daemon does on the real kernel: hosts on one switch that counts, cuts and loses, and the scenarios in
//! which what was promised must hold.
//!
//! | file | what must hold |
//! |---|---|
//! | `beside.rs` | a slow viewer and bulk change nothing for those beside them |
//! | `flaps.rs` | a link that comes and goes fifty times leaves nothing behind |
//! | `interest.rs` | nothing is sent until somebody reads, then once, and no longer than somebody reads |
//! | `hosts.rs` | hosts join, leave, die, are cut off, and come back; a host without a network is whole |
//! | `books.rs` | each sample is accounted for on each hop, and a reader is told exactly what it missed and why |
//! | `doctor.rs` | `ddx doctor` tells by direction where multicast does not pass |
//! | `load.rs` | the books balance under load, and the last value arrives under loss |
//! | `links.rs` | samples of every size cross emulated links whole and soon |
//! | `paths.rs` | samples flow on when interfaces come, go and change address |
//! | `radio.rs` | a link far too slow is shared by priority; multicast is given up where it is broken, and taken up again |
//! | `video.rs` | video crosses a link bit for bit, and only while somebody looks |
//! | `why.rs`, `why_flow.rs` | `ddx why` names the cause |

#![expect(
    clippy::unwrap_used,
    reason = "a helper of a test fails the test, as the test itself would"
)]

mod beside;
mod books;
mod doctor;
mod flaps;
mod hosts;
mod interest;
mod links;
mod load;
mod paths;
mod program;
mod radio;
mod site;
mod video;
mod why;
mod why_flow;
