//! What the bytes of an item mean, in a text that every language can read.
//!
//! ```text
//! schema Pose plain struct size 24 {
//!   x: f64 @0 unit "m" range -10..10
//!   wheels: [f32; 4] @8 unit "m/s"
//! }
//! ```
//!
//! The encoding is `plain` (little-endian, at the stated offsets, without a gap), `bincode` (bincode 2.0.1 standard, in
//! the order of the fields, without offsets) or `raw` (bytes that a foreign text describes, each line of it after `| `).
//! [`Schema::text`] prints a schema in one way only; [`Schema::hash`] covers names, types, offsets and encoding, but not
//! unit and range. [`Schema::to_json`] and [`Schema::from_json`] need nothing but the schema.

mod check;
mod difference;
mod json;
mod layout;
mod payload;
mod range;
mod text;

use std::fmt;

use ddx_wire::SchemaHash;
use ddx_wire::codec::CodecError;
use thiserror::Error;

use crate::item::Typed;

pub use layout::{Field, Scalar, Struct, Type};
pub use range::{Number, Range};

/// A checked schema: whoever holds one can lay out, print and hash it without a fault.
#[derive(Clone, Debug, PartialEq)]
pub struct Schema {
    name: String,
    body: Body,
    text: String,
    hash: SchemaHash,
}

/// How a payload's bytes follow from its schema.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Encoding {
    /// Fixed little-endian layout at stated offsets, readable in place.
    Plain,
    /// bincode 2.0.1, standard configuration.
    Bincode,
    /// Bytes that a foreign text describes.
    Raw,
}

/// A schema that is refused, or a value that does not fit one.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum SchemaError {
    /// The text is not a schema.
    #[error("schema line {line}: {fault}")]
    Text {
        /// Line of the fault, from 1.
        line: u32,
        /// What is wrong there.
        fault: String,
    },
    /// The type cannot be an item's.
    #[error("schema `{schema}`: {fault}")]
    Layout {
        /// Name of the schema.
        schema: String,
        /// What is wrong with it.
        fault: String,
    },
    /// A plain payload is not as long as its schema says.
    #[error("payload has {found} bytes, {expected} expected")]
    Length {
        /// Size of the type, bytes.
        expected: usize,
        /// Size of the payload, bytes.
        found: usize,
    },
    /// The payload is not a value of the schema's type.
    #[error("field `{field}`: {fault}")]
    Payload {
        /// Path of the field, as `pose.wheels[2]`.
        field: String,
        /// What is wrong there.
        fault: String,
    },
    /// A JSON value has another type than its field.
    #[error("field `{field}`: {expected} expected, {found} found")]
    Mismatch {
        /// Path of the field.
        field: String,
        /// What the schema asks for.
        expected: String,
        /// What the value is.
        found: String,
    },
    /// A JSON value is outside of the range of its field.
    #[error("field `{field}`: {value} is out of range {range}")]
    OutOfRange {
        /// Path of the field.
        field: String,
        /// The value.
        value: String,
        /// The range that the schema states.
        range: Range,
    },
    /// A JSON object lacks a field.
    #[error("field `{field}` is missing")]
    Missing {
        /// Path of the field.
        field: String,
    },
    /// A JSON object has a field that the schema does not have.
    #[error("field `{field}` is not in the schema")]
    Unknown {
        /// Path of the field.
        field: String,
    },
    /// The bincode codec refused a value or a payload.
    #[error(transparent)]
    Codec(#[from] CodecError),
}

#[derive(Clone, Debug, PartialEq)]
enum Body {
    Plain(Type),
    Bincode(Type),
    Raw { format: String, text: String },
}

impl Schema {
    /// The schema of the values of `T`.
    ///
    /// # Panics
    ///
    /// When `T` is no item type: nested deeper than 16, with an empty struct or array, an option in an option, or, for
    /// [`Encoding::Plain`], with a gap. A program that asks for its own types learns so at its first start.
    pub fn of<T: Typed>(name: &str, encoding: Encoding) -> Self {
        match Self::new(name, encoding, T::ty()) {
            Ok(schema) => schema,
            Err(fault) => panic!("not an item type: {fault}"),
        }
    }

    /// Checks a type and names it. [`Encoding::Raw`] has no type: [`Schema::raw`] makes such a schema.
    pub fn new(name: &str, encoding: Encoding, ty: Type) -> Result<Self, SchemaError> {
        match encoding {
            Encoding::Plain => Self::checked(name, Body::Plain(ty)),
            Encoding::Bincode => Self::checked(name, Body::Bincode(ty.without_layout())),
            Encoding::Raw => Err(refused(name, "raw bytes have no type".to_owned())),
        }
    }

    /// Bytes whose meaning the foreign `text` tells in the language `format`: `json`, `ros2msg`, `protobuf`.
    pub fn raw(name: &str, format: &str, text: &str) -> Result<Self, SchemaError> {
        let format = format.to_owned();
        let text = text.lines().collect::<Vec<_>>().join("\n");
        Self::checked(name, Body::Raw { format, text })
    }

    /// Bytes of which nothing is known.
    pub fn bytes() -> Self {
        Self::build("bytes", raw_body("bytes"))
    }

    /// A JSON text of any shape.
    pub fn json() -> Self {
        Self::build("json", raw_body("json"))
    }

    /// Reads what a person may type for a type: `u64`, `[f32; 3]`, `string`, `bytes`, `json`, or a whole schema text.
    pub fn scalar(text: &str) -> Result<Self, SchemaError> {
        match text.trim() {
            "bytes" => Ok(Self::bytes()),
            "json" => Ok(Self::json()),
            full if full.starts_with("schema ") => Self::parse(full),
            short => text::parse_type(short).and_then(|ty| match &ty {
                Type::Scalar(Scalar::Bool) => Self::new("bool", Encoding::Bincode, ty),
                Type::Scalar(scalar) => Self::new(scalar.name(), Encoding::Plain, ty),
                Type::String => Self::new("string", Encoding::Bincode, ty),
                Type::Array(..) if check::check_plain(&ty).is_ok() => {
                    Self::new("array", Encoding::Plain, ty)
                }
                Type::Array(..)
                | Type::Bytes
                | Type::Vector(_)
                | Type::Option(_)
                | Type::Struct(_)
                | Type::Enum(_) => Self::new("value", Encoding::Bincode, ty),
            }),
        }
    }

    /// Reads a schema text. A fault is named with its line; text of any size or depth costs bounded work and memory.
    pub fn parse(text: &str) -> Result<Self, SchemaError> {
        text::parse(text)
    }

    /// The schema in its one canonical spelling, which [`Schema::parse`] reads back.
    pub fn text(&self) -> &str {
        &self.text
    }

    /// Name of the type.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// How payloads are encoded.
    pub fn encoding(&self) -> Encoding {
        match self.body {
            Body::Plain(_) => Encoding::Plain,
            Body::Bincode(_) => Encoding::Bincode,
            Body::Raw { .. } => Encoding::Raw,
        }
    }

    /// Identity: the first 16 bytes of a SHA-256 over names, types, offsets and encoding.
    pub fn hash(&self) -> SchemaHash {
        self.hash
    }

    /// The type, unless the schema is raw.
    pub fn ty(&self) -> Option<&Type> {
        match &self.body {
            Body::Plain(ty) | Body::Bincode(ty) => Some(ty),
            Body::Raw { .. } => None,
        }
    }

    /// Length of every payload, bytes, where the schema fixes it: in the plain encoding.
    pub fn size_bytes(&self) -> Option<u32> {
        match &self.body {
            Body::Plain(ty) => check::check_plain(ty).ok(),
            Body::Bincode(_) | Body::Raw { .. } => None,
        }
    }

    /// Names the first thing in which `item`, the schema of an item that exists, differs from this one; `None` when they
    /// are equal. Unit and range count too.
    pub fn difference(&self, item: &Self) -> Option<String> {
        difference::first(self, item)
    }

    /// Prints a payload by the schema alone. Nothing is lost: integers beyond 2^53 become strings, as do NaN and the
    /// infinities; bytes become base64; a raw `json` payload is passed through.
    pub fn to_json(&self, payload: &[u8]) -> Result<serde_json::Value, SchemaError> {
        json::to_json(self, payload)
    }

    /// Makes a payload of a JSON value, the reverse of [`Schema::to_json`]. Missing and unknown fields, values of another
    /// type and values out of range are refused by name.
    pub fn from_json(&self, value: &serde_json::Value) -> Result<Vec<u8>, SchemaError> {
        json::from_json(self, value)
    }

    fn checked(name: &str, body: Body) -> Result<Self, SchemaError> {
        check::check_name(name)
            .and_then(|()| match &body {
                Body::Plain(ty) => check::check_plain(ty).map(|_size| ()),
                Body::Bincode(ty) => check::check_bincode(ty),
                Body::Raw { format, text } => check::check_foreign(format, text),
            })
            .map_err(|fault| refused(name, fault))?;
        let schema = Self::build(name, body);
        if schema.text.len() > TEXT_MAX_BYTES {
            let fault = format!("text is longer than {TEXT_MAX_BYTES} bytes");
            return Err(refused(name, fault));
        }
        Ok(schema)
    }

    fn build(name: &str, body: Body) -> Self {
        let identity = text::print(name, &body, text::Notes::Without);
        let digest = ring::digest::digest(&ring::digest::SHA256, identity.as_bytes());
        let mut hash = SchemaHash::default();
        hash.0
            .iter_mut()
            .zip(digest.as_ref())
            .for_each(|(to, from)| *to = *from);
        Self {
            text: text::print(name, &body, text::Notes::With),
            name: name.to_owned(),
            body,
            hash,
        }
    }
}

impl fmt::Display for Encoding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Plain => "plain",
            Self::Bincode => "bincode",
            Self::Raw => "raw",
        })
    }
}

fn refused(schema: &str, fault: String) -> SchemaError {
    SchemaError::Layout {
        schema: schema.to_owned(),
        fault,
    }
}

fn raw_body(format: &str) -> Body {
    Body::Raw {
        format: format.to_owned(),
        text: String::new(),
    }
}

/// Longest schema text, bytes: it must fit one message to the daemon beside the item's description.
pub const TEXT_MAX_BYTES: usize = 64 * 1024;
