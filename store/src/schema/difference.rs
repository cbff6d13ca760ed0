//! The first thing in which two schemas differ, in one plain sentence.

use super::layout::{Field, Struct, Type};
use super::{Body, Schema};

/// Compares from the outside in and in the order of the fields.
pub(super) fn first(here: &Schema, item: &Schema) -> Option<String> {
    if here.name != item.name {
        return Some(format!(
            "the type is `{}` here, `{}` in the item",
            here.name, item.name
        ));
    }
    match (&here.body, &item.body) {
        (Body::Plain(a), Body::Plain(b)) | (Body::Bincode(a), Body::Bincode(b)) => {
            in_type("", a, b)
        }
        (
            Body::Raw { format, text },
            Body::Raw {
                format: item_format,
                text: item_text,
            },
        ) => {
            if format != item_format {
                return Some(format!(
                    "the format is {format} here, {item_format} in the item"
                ));
            }
            in_text(text, item_text)
        }
        _ => Some(format!(
            "the encoding is {} here, {} in the item",
            here.encoding(),
            item.encoding()
        )),
    }
}

fn in_type(path: &str, here: &Type, item: &Type) -> Option<String> {
    match (here, item) {
        (Type::Struct(a), Type::Struct(b)) => in_struct(path, a, b),
        (Type::Array(a, count), Type::Array(b, item_count)) if count == item_count => {
            in_type(&format!("{path}[]"), a, b)
        }
        (Type::Vector(a), Type::Vector(b)) => in_type(&format!("{path}[]"), a, b),
        (Type::Option(a), Type::Option(b)) => in_type(path, a, b),
        _ if here == item => None,
        _ => Some(differs(path, "", here, item)),
    }
}

fn in_struct(path: &str, here: &Struct, item: &Struct) -> Option<String> {
    let known = |shape: &Struct, name: &str| shape.fields.iter().any(|field| field.name == name);
    for (a, b) in here.fields.iter().zip(&item.fields) {
        if a.name != b.name {
            return Some(match (known(item, &a.name), known(here, &b.name)) {
                (false, _) => format!("{} is not in the item", subject(&below(path, &a.name))),
                (true, false) => format!("{} is only in the item", subject(&below(path, &b.name))),
                (true, true) => format!(
                    "{} stands where the item has `{}`",
                    subject(&below(path, &a.name)),
                    b.name
                ),
            });
        }
        if let Some(difference) = in_field(&below(path, &a.name), a, b) {
            return Some(difference);
        }
    }
    let shared = here.fields.len().min(item.fields.len());
    if let Some(extra) = here.fields.get(shared) {
        return Some(format!(
            "{} is not in the item",
            subject(&below(path, &extra.name))
        ));
    }
    let extra = item.fields.get(shared)?;
    Some(format!(
        "{} is only in the item",
        subject(&below(path, &extra.name))
    ))
}

fn in_field(path: &str, here: &Field, item: &Field) -> Option<String> {
    if let Some(difference) = in_type(path, &here.ty, &item.ty) {
        return Some(difference);
    }
    if here.offset_bytes != item.offset_bytes {
        let offset = |field: &Field| {
            field
                .offset_bytes
                .map_or("none".to_owned(), |o| o.to_string())
        };
        return Some(differs(path, "offset ", offset(here), offset(item)));
    }
    if here.unit != item.unit {
        let unit = |field: &Field| {
            let quoted = field.unit.as_ref().map(|unit| format!("`{unit}`"));
            quoted.unwrap_or_else(|| "none".to_owned())
        };
        return Some(differs(path, "unit ", unit(here), unit(item)));
    }
    if here.range != item.range {
        let range = |field: &Field| field.range.map_or("none".to_owned(), |r| r.to_string());
        return Some(differs(path, "range ", range(here), range(item)));
    }
    None
}

fn in_text(here: &str, item: &str) -> Option<String> {
    let same = here
        .split('\n')
        .zip(item.split('\n'))
        .take_while(|(a, b)| a == b)
        .count();
    (here != item).then(|| {
        format!(
            "the foreign text differs from its line {}",
            same.saturating_add(1)
        )
    })
}

fn differs(
    path: &str,
    what: &str,
    here: impl std::fmt::Display,
    item: impl std::fmt::Display,
) -> String {
    // A type is shown with all its fields, which may be a thousand; the start of it tells two apart.
    let shown = |side: &dyn std::fmt::Display| -> String {
        side.to_string().chars().take(SHOWN_MAX_CHARS).collect()
    };
    let (here, item) = (shown(&here), shown(&item));
    format!("{}: {what}{here} here, {item} in the item", subject(path))
}

/// Longest text of a type, unit or range in a difference.
const SHOWN_MAX_CHARS: usize = 80;

fn subject(path: &str) -> String {
    match path {
        "" => "the type".to_owned(),
        path => format!("field `{path}`"),
    }
}

fn below(path: &str, name: &str) -> String {
    match path {
        "" => name.to_owned(),
        path => format!("{path}.{name}"),
    }
}
