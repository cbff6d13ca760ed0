//! `ddx put`: writes one value, which the daemon then holds.

use anyhow::Context as _;
use ddx_store::schema::Type;
use ddx_store::{Schema, Store};
use serde_json::{Value, json};

use super::Context;
use crate::error::{Exit, Failure, Hint as _, Outcome};

/// Which item, and what.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Name of the item
    name: String,
    /// Value, as JSON
    #[arg(allow_hyphen_values = true)]
    value: String,
    /// Type of a new item: `f64`, `[f32; 3]`, `string`, `json`, or a schema text
    #[arg(long = "type", value_name = "TYPE")]
    ty: Option<String>,
}

/// Runs the verb.
pub(crate) fn run(context: &mut Context, args: &Args) -> Outcome {
    let store = context.store("put")?;
    let schema = schema(&store, args)?;
    let value = value(&args.value, &schema)?;
    let payload = schema
        .from_json(&value)
        .with_context(|| format!("`{}` is not a value of `{}`", args.value, args.name))
        .hint(|| format!("`ddx info {}` shows its type", args.name))
        .arguments()?;
    store.put(&args.name, &schema, &payload)?;
    context.out.either(
        &json!({ "name": args.name, "value": value }),
        &format!("{} = {}", args.name, args.value),
    )?;
    Ok(Exit::Done)
}

/// The schema asked for, else that of the item.
fn schema(store: &Store, args: &Args) -> Result<Schema, Failure> {
    if let Some(text) = &args.ty {
        return Schema::scalar(text)
            .with_context(|| format!("`{text}` is not a type"))
            .hint(|| {
                "types: bool, u8 to u64, i8 to i64, f32, f64, `[f32; 3]`, string, bytes, json"
                    .to_owned()
            })
            .arguments();
    }
    let text = store
        .describe(&args.name)
        .hint(|| {
            format!(
                "a new item needs a type: `ddx put {} {} --type f64`",
                args.name, args.value
            )
        })?
        .schema;
    Schema::parse(&text)
        .with_context(|| format!("the type of `{}` is not known yet", args.name))
        .map_err(Failure::from)
}

/// Reads JSON. Where a string is wanted, a bare word is one too, because a shell takes quotes away.
fn value(text: &str, schema: &Schema) -> Result<Value, Failure> {
    let parsed = serde_json::from_str::<Value>(text);
    if matches!(schema.ty(), Some(Type::String)) && !matches!(parsed, Ok(Value::String(_))) {
        return Ok(Value::String(text.to_owned()));
    }
    parsed
        .with_context(|| format!("`{text}` is not JSON"))
        .hint(|| "write 1.5, true, '\"text\"', '[1, 2]' or '{\"x\": 1}'".to_owned())
        .arguments()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bare_word_is_a_string_only_where_one_is_wanted() {
        let string = Schema::scalar("string").unwrap();
        let number = Schema::scalar("f64").unwrap();

        assert_eq!(value("hello", &string).unwrap(), json!("hello"));
        assert_eq!(value("7", &string).unwrap(), json!("7"));
        assert_eq!(value("\"quoted\"", &string).unwrap(), json!("quoted"));
        assert_eq!(value("1.5", &number).unwrap(), json!(1.5));
        assert_eq!(
            value("hello", &number).unwrap_err().exit(),
            Exit::BadArguments
        );
    }
}
