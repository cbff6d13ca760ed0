//! `ddx host ls`: the hosts of the domain.

use super::render::{Table, span};
use super::{Context, state};
use crate::error::{Exit, Outcome};

/// What about hosts.
#[derive(Debug, clap::Subcommand)]
pub(crate) enum Verb {
    /// List the hosts of the domain, with state and round trip
    Ls,
}

/// Runs the verb.
pub(crate) fn run(context: &mut Context, verb: &Verb) -> Outcome {
    let Verb::Ls = verb;
    let store = context.store("host ls")?;
    if context.out.json {
        let listed = state::read(&store, "@/hosts")?.unwrap_or_default();
        for host in listed.as_array().into_iter().flatten() {
            context.out.object(host)?;
        }
        return Ok(Exit::Done);
    }
    let now = ddx_store::now();
    let mut table = Table::new(&[
        "HOST",
        "STATE",
        "SINCE",
        "ROUND TRIP",
        "LOSS",
        "ADDRESS",
        "ID",
    ]);
    for host in state::hosts(&store)? {
        let ago = host.since.map(|since| span(now.0.saturating_sub(since)));
        table.row(vec![
            host.host,
            host.state,
            ago.unwrap_or_else(unknown),
            host.rtt_us
                .map_or_else(unknown, |us| span(us.saturating_mul(1_000))),
            host.loss_percent
                .map_or_else(unknown, |percent| format!("{percent:.1} %")),
            address(host.addr, host.paths.len()),
            host.id,
        ]);
    }
    for line in table.lines() {
        context.out.line(&line)?;
    }
    if !state::own(&store)?.key {
        super::output::note(
            "this host has no key, so that it serves itself only\nhint: `ddx key new > FILE`, then `ddx up --key FILE` on each host",
        );
    }
    Ok(Exit::Done)
}

/// The address in use, and how many others there are.
fn address(used: Option<String>, paths: usize) -> String {
    let used = used.unwrap_or_else(unknown);
    match paths {
        0 | 1 => used,
        several => format!("{used} (of {several})"),
    }
}

fn unknown() -> String {
    "?".to_owned()
}
