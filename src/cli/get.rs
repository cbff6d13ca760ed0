//! `ddx get`: the present value of an item.

use std::time::Duration;

use ddx_store::ReaderOptions;

use super::subscription::Subscription;
use super::{Context, render, why};
use crate::error::{Exit, Failure, Outcome};
use crate::units;

/// Which item.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Name of the item
    name: String,
    /// Longest wait for a value, as `500 ms`
    #[arg(long, value_name = "TIME", default_value = "2 s", value_parser = units::span)]
    timeout: Duration,
}

/// Runs the verb.
pub(crate) fn run(context: &mut Context, args: &Args) -> Outcome {
    let store = context.store("get")?;
    let mut subscription = Subscription::open(&store, &args.name, ReaderOptions::default())?;
    if let Some(seen) = subscription.first(args.timeout)? {
        let now = ddx_store::now();
        let text = format!(
            "{}   {}",
            render::value(&seen.value, usize::MAX),
            seen.age(now)
        );
        context.out.either(&subscription.object(now), &text)?;
        return Ok(Exit::Done);
    }
    let verdict = why::explain(&store, &args.name)?;
    let waited = units::spell_span(args.timeout);
    let failure = Failure::new(format!(
        "no value of `{}` within {waited}: {}",
        args.name, verdict.sentence
    ));
    Err(match verdict.hint {
        Some(hint) => failure.with_hint(hint),
        None => failure,
    })
}
