//! The types that a schema may hold.

use std::fmt;

use super::range::Range;

/// The type of a value.
#[derive(Clone, Debug, PartialEq)]
pub enum Type {
    /// A number or a bool.
    Scalar(Scalar),
    /// UTF-8 text; not in a plain schema.
    String,
    /// Bytes of any number, which JSON shows as base64; not in a plain schema.
    Bytes,
    /// A fixed number of elements.
    Array(Box<Self>, u32),
    /// Any number of elements; not in a plain schema.
    Vector(Box<Self>),
    /// A value or none; not in a plain schema.
    Option(Box<Self>),
    /// Named fields.
    Struct(Struct),
    /// One of these names; not in a plain schema.
    Enum(Vec<String>),
}

/// A number or a bool.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[expect(missing_docs, reason = "the names are those of the Rust types")]
pub enum Scalar {
    U8,
    U16,
    U32,
    U64,
    I8,
    I16,
    I32,
    I64,
    F32,
    F64,
    Bool,
}

/// Fields in order, and the size in bytes that a plain schema states.
#[derive(Clone, Debug, PartialEq)]
pub struct Struct {
    /// In the order of memory (plain) or of the encoding (bincode).
    pub fields: Vec<Field>,
    /// Size, bytes; only in a plain schema.
    pub size_bytes: Option<u32>,
}

/// One field of a struct.
#[derive(Clone, Debug, PartialEq)]
pub struct Field {
    /// Unique in its struct.
    pub name: String,
    /// Type of the value.
    pub ty: Type,
    /// Bytes from the start of the struct; only in a plain schema.
    pub offset_bytes: Option<u32>,
    /// Unit of the number or numbers, as `m/s`.
    pub unit: Option<String>,
    /// Range of the number or numbers.
    pub range: Option<Range>,
}

impl Scalar {
    const ALL: [Self; 11] = [
        Self::U8,
        Self::U16,
        Self::U32,
        Self::U64,
        Self::I8,
        Self::I16,
        Self::I32,
        Self::I64,
        Self::F32,
        Self::F64,
        Self::Bool,
    ];

    /// The name in a schema text, which is that of the Rust type.
    pub fn name(self) -> &'static str {
        match self {
            Self::U8 => "u8",
            Self::U16 => "u16",
            Self::U32 => "u32",
            Self::U64 => "u64",
            Self::I8 => "i8",
            Self::I16 => "i16",
            Self::I32 => "i32",
            Self::I64 => "i64",
            Self::F32 => "f32",
            Self::F64 => "f64",
            Self::Bool => "bool",
        }
    }

    /// Size and alignment in a plain schema, bytes.
    pub fn size_bytes(self) -> u32 {
        match self {
            Self::U8 | Self::I8 | Self::Bool => 1,
            Self::U16 | Self::I16 => 2,
            Self::U32 | Self::I32 | Self::F32 => 4,
            Self::U64 | Self::I64 | Self::F64 => 8,
        }
    }

    pub(super) fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|scalar| scalar.name() == name)
    }
}

impl Type {
    /// A fixed number of elements.
    pub fn array(element: Self, count: usize) -> Self {
        // A count that does not fit saturates, and no check lets so large a type pass.
        let count = u32::try_from(count).unwrap_or(u32::MAX);
        Self::Array(Box::new(element), count)
    }

    /// Any number of elements; of `u8` it is [`Type::Bytes`], which has the same encoding.
    pub fn vector(element: Self) -> Self {
        if element == Self::Scalar(Scalar::U8) {
            return Self::Bytes;
        }
        Self::Vector(Box::new(element))
    }

    /// A value or none.
    pub fn option(value: Self) -> Self {
        Self::Option(Box::new(value))
    }

    /// Fields as they lie in memory, and how many bytes they take.
    pub fn plain_struct(size_bytes: usize, fields: Vec<Field>) -> Self {
        Self::Struct(Struct {
            fields,
            size_bytes: Some(u32::try_from(size_bytes).unwrap_or(u32::MAX)),
        })
    }

    /// Fields in the order in which they are encoded.
    pub fn bincode_struct(fields: Vec<Field>) -> Self {
        Self::Struct(Struct {
            fields,
            size_bytes: None,
        })
    }

    /// The same type as another encoding sees it: without sizes and offsets.
    pub fn without_layout(self) -> Self {
        match self {
            Self::Scalar(_) | Self::String | Self::Bytes | Self::Enum(_) => self,
            Self::Array(element, count) => Self::Array(Box::new(element.without_layout()), count),
            Self::Vector(element) => Self::Vector(Box::new(element.without_layout())),
            Self::Option(value) => Self::Option(Box::new(value.without_layout())),
            Self::Struct(shape) => Self::Struct(Struct {
                size_bytes: None,
                fields: shape
                    .fields
                    .into_iter()
                    .map(|field| Field {
                        offset_bytes: None,
                        ty: field.ty.without_layout(),
                        ..field
                    })
                    .collect(),
            }),
        }
    }

    /// What the unit and the range of a field speak of: the number inside arrays, vectors and options.
    pub(super) fn number(&self) -> Option<Scalar> {
        match self {
            Self::Scalar(Scalar::Bool)
            | Self::String
            | Self::Bytes
            | Self::Struct(_)
            | Self::Enum(_) => None,
            Self::Scalar(scalar) => Some(*scalar),
            Self::Array(inner, _) | Self::Vector(inner) | Self::Option(inner) => inner.number(),
        }
    }
}

impl Field {
    /// A field without offset, unit and range.
    pub fn new(name: &str, ty: Type) -> Self {
        Self {
            name: name.to_owned(),
            ty,
            offset_bytes: None,
            unit: None,
            range: None,
        }
    }

    /// Puts the field at an offset, bytes, as a plain schema asks.
    #[must_use]
    pub fn at(self, offset_bytes: usize) -> Self {
        // An offset that does not fit saturates, and no check lets so large a struct pass.
        let offset_bytes = Some(u32::try_from(offset_bytes).unwrap_or(u32::MAX));
        Self {
            offset_bytes,
            ..self
        }
    }

    /// States the unit.
    #[must_use]
    pub fn unit(self, unit: &str) -> Self {
        Self {
            unit: Some(unit.to_owned()),
            ..self
        }
    }

    /// States the range.
    #[must_use]
    pub fn range(self, range: Range) -> Self {
        Self {
            range: Some(range),
            ..self
        }
    }
}

impl fmt::Display for Type {
    /// Prints one line: what a struct holds is left out.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Scalar(scalar) => f.write_str(scalar.name()),
            Self::String => f.write_str("string"),
            Self::Bytes => f.write_str("bytes"),
            Self::Array(element, count) => write!(f, "[{element}; {count}]"),
            Self::Vector(element) => write!(f, "[{element}]"),
            Self::Option(value) => write!(f, "option<{value}>"),
            Self::Struct(shape) => write!(f, "struct of {} fields", shape.fields.len()),
            Self::Enum(names) => write!(f, "enum {{ {} }}", names.join(", ")),
        }
    }
}
