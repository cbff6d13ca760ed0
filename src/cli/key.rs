//! `ddx key new`: a new domain key on standard output.

use ddx_wire::seal::DomainKey;
use serde_json::json;

use super::Context;
use crate::error::{Exit, Outcome};
use crate::identity;

/// What about keys.
#[derive(Debug, clap::Subcommand)]
pub(crate) enum Verb {
    /// Print a new domain key; keep it in a file that only you can read
    New,
}

/// Runs the verb.
pub(crate) fn run(context: &mut Context, verb: &Verb) -> Outcome {
    let Verb::New = verb;
    let text = text()?;
    context.out.either(&json!({ "key": text }), &text)?;
    Ok(Exit::Done)
}

/// 32 random bytes as 64 hexadecimal digits.
pub(crate) fn text() -> anyhow::Result<String> {
    Ok(DomainKey::from_bytes(identity::random()?).to_text())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_key_is_64_hex_digits_and_no_two_are_alike() {
        let (one, two) = (text().unwrap(), text().unwrap());

        assert_eq!(one.len(), 64);
        assert!(one.bytes().all(|byte| byte.is_ascii_hexdigit()));
        assert_ne!(one, two);
    }
}
