//! The attributes that the derive reads: its own, `repr`, and those of serde that it must not overlook.

use syn::meta::ParseNestedMeta;
use syn::punctuated::Punctuated;
use syn::{Attribute, Error, LitStr, Meta, Result, Token};

/// How the values of the type become bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Encoding {
    Plain,
    Bincode,
}

/// What `#[ddx(..)]` says on a type.
pub(crate) struct TypeAttributes {
    pub(crate) name: Option<String>,
    pub(crate) encoding: Encoding,
}

/// What `#[ddx(..)]` says on a field.
#[derive(Default)]
pub(crate) struct FieldAttributes {
    pub(crate) unit: Option<String>,
    pub(crate) range: Option<(Option<Bound>, Option<Bound>)>,
}

/// One end of a range.
#[derive(Clone, Copy)]
pub(crate) enum Bound {
    Integer(i128),
    Float(f64),
}

impl TypeAttributes {
    pub(crate) fn read(attributes: &[Attribute]) -> Result<Self> {
        let (mut name, mut encoding) = (None, None);
        each_ddx(attributes, |meta| {
            if meta.path.is_ident("name") {
                let text = text_of(&meta)?;
                if !is_name(&text.value()) {
                    let rule = "a name is letters, digits and `_`, joined by `.`, `/` or `::`";
                    return Err(Error::new(text.span(), rule));
                }
                once(&meta, &mut name, text.value())
            } else if meta.path.is_ident("encoding") {
                let text = text_of(&meta)?;
                let value = match text.value().as_str() {
                    "plain" => Encoding::Plain,
                    "bincode" => Encoding::Bincode,
                    _ => {
                        return Err(Error::new(
                            text.span(),
                            "an encoding is `plain` or `bincode`",
                        ));
                    }
                };
                once(&meta, &mut encoding, value)
            } else {
                Err(meta.error("a type has the attributes `name` and `encoding`"))
            }
        })?;
        Ok(Self {
            name,
            encoding: encoding.unwrap_or(Encoding::Plain),
        })
    }
}

impl FieldAttributes {
    pub(crate) fn read(attributes: &[Attribute]) -> Result<Self> {
        let mut read = Self::default();
        each_ddx(attributes, |meta| {
            if meta.path.is_ident("unit") {
                let text = text_of(&meta)?;
                if !is_unit(&text.value()) {
                    let rule = "a unit has 1 to 32 bytes, no quote, backslash or control character";
                    return Err(Error::new(text.span(), rule));
                }
                once(&meta, &mut read.unit, text.value())
            } else if meta.path.is_ident("range") {
                let text = text_of(&meta)?;
                let rule = "a range is `low..high`, `low..` or `..high`, both ends included";
                let range = range_of(&text.value()).ok_or_else(|| Error::new(text.span(), rule))?;
                once(&meta, &mut read.range, range)
            } else {
                Err(meta.error("a field has the attributes `unit` and `range`"))
            }
        })?;
        Ok(read)
    }
}

/// Refuses every serde attribute that could make the bytes differ from the schema. Names do not reach the bytes, so
/// renaming is harmless.
pub(crate) fn check_serde(attributes: &[Attribute]) -> Result<()> {
    const HARMLESS: [&str; 6] = [
        "alias",
        "bound",
        "crate",
        "deny_unknown_fields",
        "rename",
        "rename_all",
    ];
    for attribute in attributes.iter().filter(|a| a.path().is_ident("serde")) {
        let inside = attribute.parse_args_with(Punctuated::<Meta, Token![,]>::parse_terminated)?;
        for meta in inside {
            let path = meta.path();
            if !HARMLESS.iter().any(|harmless| path.is_ident(harmless)) {
                return Err(Error::new_spanned(
                    path,
                    "this serde attribute can make the bytes differ from the schema: remove it, or write the item as `Vec<u8>`",
                ));
            }
        }
    }
    Ok(())
}

/// Whether the representation is exactly `C`.
pub(crate) fn is_repr_c(attributes: &[Attribute]) -> Result<bool> {
    let mut words = Vec::new();
    for attribute in attributes.iter().filter(|a| a.path().is_ident("repr")) {
        words.extend(attribute.parse_args_with(Punctuated::<Meta, Token![,]>::parse_terminated)?);
    }
    Ok(matches!(words.as_slice(), [only] if only.path().is_ident("C")))
}

fn each_ddx(
    attributes: &[Attribute],
    mut read: impl FnMut(ParseNestedMeta<'_>) -> Result<()>,
) -> Result<()> {
    attributes
        .iter()
        .filter(|attribute| attribute.path().is_ident("ddx"))
        .try_for_each(|attribute| attribute.parse_nested_meta(&mut read))
}

fn text_of(meta: &ParseNestedMeta<'_>) -> Result<LitStr> {
    meta.value()?.parse()
}

fn once<T>(meta: &ParseNestedMeta<'_>, slot: &mut Option<T>, value: T) -> Result<()> {
    match slot.replace(value) {
        None => Ok(()),
        Some(_) => Err(meta.error("the attribute is there twice")),
    }
}

fn is_name(text: &str) -> bool {
    let chunks = text.replace("::", ".").replace('/', ".");
    text.len() <= 128
        && chunks.split('.').all(|chunk| {
            chunk.starts_with(|c: char| c.is_ascii_alphabetic() || c == '_')
                && chunk
                    .bytes()
                    .all(|b| b.is_ascii_alphanumeric() || b == b'_')
        })
}

fn is_unit(text: &str) -> bool {
    (1..=32).contains(&text.len())
        && text
            .chars()
            .all(|c| !c.is_control() && c != '"' && c != '\\')
}

fn range_of(text: &str) -> Option<(Option<Bound>, Option<Bound>)> {
    let end = |text: &str| match text {
        "" => Some(None),
        digits => bound_of(digits).map(Some),
    };
    let (low, high) = text.split_once("..")?;
    match (end(low)?, end(high)?) {
        (None, None) => None,
        (Some(low), Some(high)) if !low.at_most(high) => None,
        range => Some(range),
    }
}

fn bound_of(text: &str) -> Option<Bound> {
    let digits = text.strip_prefix('-').unwrap_or(text);
    if !digits.starts_with(|c: char| c.is_ascii_digit()) {
        return None;
    }
    if digits.bytes().all(|b| b.is_ascii_digit()) {
        return text.parse().ok().map(Bound::Integer);
    }
    text.parse()
        .ok()
        .filter(|float: &f64| float.is_finite())
        .map(Bound::Float)
}

impl Bound {
    fn at_most(self, other: Self) -> bool {
        match (self, other) {
            (Self::Integer(a), Self::Integer(b)) => a <= b,
            (a, b) => a.as_float() <= b.as_float(),
        }
    }

    fn as_float(self) -> f64 {
        match self {
            Self::Integer(integer) => integer as f64,
            Self::Float(float) => float,
        }
    }
}
