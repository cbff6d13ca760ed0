//! Derives the schema of an item type: `#[derive(ddx_store::Item)]`.
//!
//! A `plain` struct (the default) needs `#[repr(C)]`, `Clone` and `Copy`; its fields are numbers, fixed arrays and plain
//! structs without a gap between them. With `#[ddx(encoding = "bincode")]` the type needs serde's `Serialize` and
//! `Deserialize`, and may hold bools, strings, vectors, options and enums without data. What would let the schema and the
//! bytes disagree does not compile, and the error names the fix.
//!
//! | Attribute | On | Meaning |
//! |---|---|---|
//! | `name = "Pose"` | type | name in the schema, by default the type's |
//! | `encoding = "bincode"` | type | `plain` or `bincode` |
//! | `unit = "m/s"` | field | unit of the number or numbers |
//! | `range = "-10..10"` | field | least and greatest value, both included, either optional |

mod attributes;
mod expand;

use proc_macro::TokenStream;
use syn::{DeriveInput, parse_macro_input};

/// Implements `Item` and `Typed`, and for the plain encoding `Plain`.
#[proc_macro_derive(Item, attributes(ddx))]
pub fn derive_item(input: TokenStream) -> TokenStream {
    let input = parse_macro_input!(input as DeriveInput);
    expand::item(&input)
        .unwrap_or_else(|fault| fault.to_compile_error())
        .into()
}
