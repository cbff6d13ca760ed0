//! `ddx topic …`: hidden aliases of `ls`, `watch`, `hz` and `info`, for those who come from ROS 2.

use super::{Context, hz, info, ls, watch};
use crate::error::Outcome;

/// The verbs of `ros2 topic` that have one of ours.
#[derive(Debug, clap::Subcommand)]
pub(crate) enum Verb {
    /// `ddx ls`
    List(ls::Args),
    /// `ddx watch`
    Echo(watch::Args),
    /// `ddx hz`
    Hz(hz::Args),
    /// `ddx info`
    Info(info::Args),
}

/// Runs the verb that the alias stands for.
pub(crate) fn run(context: &mut Context, verb: &Verb) -> Outcome {
    match verb {
        Verb::List(args) => ls::run(context, args),
        Verb::Echo(args) => watch::run(context, args),
        Verb::Hz(args) => hz::run(context, args),
        Verb::Info(args) => info::run(context, args),
    }
}
