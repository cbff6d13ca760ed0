//! `ddx rm`: removes an item that no program writes.

use serde_json::json;

use super::Context;
use crate::error::{Exit, Hint as _, Outcome};

/// Which item.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Name of the item
    name: String,
}

/// Runs the verb.
pub(crate) fn run(context: &mut Context, args: &Args) -> Outcome {
    let store = context.store("rm")?;
    store.remove(&args.name).hint(|| {
        "only an item of this host goes, and only when no program writes it: see `ddx ls`"
            .to_owned()
    })?;
    context.out.either(
        &json!({ "removed": args.name }),
        &format!("removed {}", args.name),
    )?;
    Ok(Exit::Done)
}
