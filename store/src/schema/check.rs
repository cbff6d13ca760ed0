//! The rules that every schema obeys, whoever wrote it: a Rust type, a person or a hostile program.

use std::collections::BTreeSet;

use super::layout::{Field, Scalar, Struct, Type};
use super::range::Range;

/// Checks that fields lie one after the other without a gap and fill the stated size, and returns that size in bytes.
pub(super) fn check_plain(ty: &Type) -> Result<u32, String> {
    let mut budget = Budget { names: NAMES_MAX };
    ty.plain_size_and_align(&mut budget, 0)
        .map(|(size, _align)| size)
}

/// Checks that every value takes at least one byte and can be told from every other in JSON.
pub(super) fn check_bincode(ty: &Type) -> Result<(), String> {
    ty.check_bincode(&mut Budget { names: NAMES_MAX }, 0)
}

/// Checks the language and the text of a raw schema.
pub(super) fn check_foreign(format: &str, text: &str) -> Result<(), String> {
    if !is_identifier(format) {
        return Err(format!("`{format}` is not a format name"));
    }
    if text
        .chars()
        .any(|c| c.is_control() && c != '\n' && c != '\t')
    {
        return Err("control character in the foreign text".to_owned());
    }
    Ok(())
}

/// Checks the name of a schema: identifiers joined by `.`, `/` or `::`.
pub(super) fn check_name(name: &str) -> Result<(), String> {
    let chunks = name.replace("::", ".").replace('/', ".");
    if name.len() <= NAME_MAX_BYTES && chunks.split('.').all(is_identifier) {
        return Ok(());
    }
    Err(format!(
        "a name is letters, digits and `_`, joined by `.`, `/` or `::`, at most {NAME_MAX_BYTES} bytes"
    ))
}

/// Whether `text` can name a field.
pub(super) fn is_identifier(text: &str) -> bool {
    text.len() <= NAME_MAX_BYTES
        && text.starts_with(|c: char| c.is_ascii_alphabetic() || c == '_')
        && text.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'_')
}

impl Type {
    /// Size and alignment in the plain encoding, bytes, of a type that has passed or is under [`check_plain`].
    fn plain_size_and_align(&self, budget: &mut Budget, depth: u32) -> Result<(u32, u32), String> {
        budget.enter(depth)?;
        match self {
            Self::Scalar(Scalar::Bool) => Err(
                "a bool is not valid under every bit pattern: use u8, or the bincode encoding"
                    .to_owned(),
            ),
            Self::Scalar(scalar) => Ok((scalar.size_bytes(), scalar.size_bytes())),
            Self::Array(_, 0) => Err("an array of no elements".to_owned()),
            Self::Array(element, count) => {
                let (size, align) =
                    element.plain_size_and_align(budget, depth.saturating_add(1))?;
                let size = size
                    .checked_mul(*count)
                    .filter(|size| *size <= PLAIN_MAX_BYTES)
                    .ok_or_else(|| format!("larger than {PLAIN_MAX_BYTES} bytes"))?;
                Ok((size, align))
            }
            Self::Struct(shape) => shape.plain_size_and_align(budget, depth),
            Self::String | Self::Bytes | Self::Vector(_) | Self::Option(_) | Self::Enum(_) => Err(
                format!("{self} has no fixed size: use the bincode encoding"),
            ),
        }
    }

    fn check_bincode(&self, budget: &mut Budget, depth: u32) -> Result<(), String> {
        budget.enter(depth)?;
        let below = depth.saturating_add(1);
        match self {
            Self::Scalar(_) | Self::String | Self::Bytes => Ok(()),
            // A value without bytes would let a short payload claim any number of values.
            Self::Array(_, 0) => Err("an array of no elements".to_owned()),
            Self::Array(element, _) | Self::Vector(element) => element.check_bincode(budget, below),
            // JSON could not tell no value from no value inside.
            Self::Option(value) if matches!(**value, Self::Option(_)) => {
                Err("an option in an option".to_owned())
            }
            Self::Option(value) => value.check_bincode(budget, below),
            Self::Enum(names) => {
                if names.is_empty() {
                    return Err("an enum without names".to_owned());
                }
                budget.spend(names.len())?;
                check_unique(names.iter().map(String::as_str))
            }
            Self::Struct(shape) => {
                shape.check_fields(budget)?;
                if shape.size_bytes.is_some() {
                    return Err("a bincode struct has no size".to_owned());
                }
                shape.fields.iter().try_for_each(|field| {
                    if field.offset_bytes.is_some() {
                        return Err(format!("field `{}`: bincode has no offsets", field.name));
                    }
                    field
                        .ty
                        .check_bincode(budget, below)
                        .map_err(|fault| in_field(&field.name, &fault))
                })
            }
        }
    }
}

impl Struct {
    fn check_fields(&self, budget: &mut Budget) -> Result<(), String> {
        if self.fields.is_empty() {
            return Err("a struct without fields".to_owned());
        }
        budget.spend(self.fields.len())?;
        check_unique(self.fields.iter().map(|field| field.name.as_str()))?;
        self.fields.iter().try_for_each(|field| {
            field
                .check_notes()
                .map_err(|fault| in_field(&field.name, &fault))
        })
    }

    fn plain_size_and_align(&self, budget: &mut Budget, depth: u32) -> Result<(u32, u32), String> {
        self.check_fields(budget)?;
        let stated = self
            .size_bytes
            .ok_or("a plain struct must state its size")?;
        let (mut end, mut align) = (0_u32, 1_u32);
        for field in &self.fields {
            let (size, field_align) = field
                .ty
                .plain_size_and_align(budget, depth.saturating_add(1))
                .map_err(|fault| in_field(&field.name, &fault))?;
            let fault = match field.offset_bytes {
                None => Some("a plain field must state its offset".to_owned()),
                Some(offset) if offset < end => Some(format!(
                    "offset {offset} overlaps the field before, which ends at {end}"
                )),
                Some(offset) if offset > end => Some(format!(
                    "gap from {end} to {offset}: fill it with a field of u8"
                )),
                Some(offset) if offset % field_align != 0 => Some(format!(
                    "offset {offset} is not a multiple of {field_align}"
                )),
                Some(_) => None,
            };
            if let Some(fault) = fault {
                return Err(in_field(&field.name, &fault));
            }
            align = align.max(field_align);
            end = end
                .checked_add(size)
                .filter(|end| *end <= PLAIN_MAX_BYTES)
                .ok_or_else(|| format!("larger than {PLAIN_MAX_BYTES} bytes"))?;
        }
        if stated != end {
            return Err(format!("size {stated} is stated, the fields end at {end}"));
        }
        if end % align != 0 {
            let fill = align.saturating_sub(end % align);
            return Err(format!(
                "size {end} is not a multiple of {align}: add a last field of {fill} u8"
            ));
        }
        Ok((end, align))
    }
}

impl Field {
    fn check_notes(&self) -> Result<(), String> {
        if self.unit.is_some() || self.range.is_some() {
            let number = self.ty.number();
            number.ok_or("only a number has a unit or a range")?;
        }
        if let Some(unit) = &self.unit {
            let plain = |c: char| !c.is_control() && c != '"' && c != '\\';
            if unit.is_empty() || unit.len() > UNIT_MAX_BYTES || !unit.chars().all(plain) {
                return Err(format!(
                    "a unit has 1 to {UNIT_MAX_BYTES} bytes, no quote, backslash or control character"
                ));
            }
        }
        match self.range {
            Some(Range {
                low: None,
                high: None,
            }) => Err("a range without an end".to_owned()),
            Some(Range {
                low: Some(low),
                high: Some(high),
            }) if !low.at_most(high) => Err(format!("range {low}..{high} is empty")),
            Some(_) | None => Ok(()),
        }
    }
}

/// Counts down while a type is walked, so that a hostile one costs bounded work.
struct Budget {
    names: usize,
}

impl Budget {
    fn enter(&self, depth: u32) -> Result<(), String> {
        if depth > DEPTH_MAX {
            return Err(format!("nested deeper than {DEPTH_MAX}"));
        }
        Ok(())
    }

    fn spend(&mut self, names: usize) -> Result<(), String> {
        self.names = self
            .names
            .checked_sub(names)
            .ok_or_else(|| format!("more than {NAMES_MAX} fields"))?;
        Ok(())
    }
}

fn check_unique<'a>(names: impl Iterator<Item = &'a str>) -> Result<(), String> {
    let mut seen = BTreeSet::new();
    for name in names {
        if !is_identifier(name) {
            return Err(format!("`{name}` is not a field name"));
        }
        if !seen.insert(name) {
            return Err(format!("`{name}` is there twice"));
        }
    }
    Ok(())
}

fn in_field(name: &str, fault: &str) -> String {
    match fault.strip_prefix("field `") {
        Some(below) => format!("field `{name}.{below}"),
        None => format!("field `{name}`: {fault}"),
    }
}

/// Deepest nesting of types.
pub(super) const DEPTH_MAX: u32 = 16;
/// Most fields and enum names in one schema.
const NAMES_MAX: usize = 1024;
/// Longest schema, field or format name, bytes.
const NAME_MAX_BYTES: usize = 128;
/// Longest unit, bytes.
const UNIT_MAX_BYTES: usize = 32;
/// Largest plain value, bytes: what a 32-bit host can map beside everything else.
const PLAIN_MAX_BYTES: u32 = 1 << 30;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_identifiers_joined_by_the_separators_of_any_language() {
        for name in ["Pose", "robot.Pose", "sensor_msgs/msg/Image", "nav::Fix2"] {
            assert_eq!(check_name(name), Ok(()));
        }
        for name in ["", "2d", "a b", "a:b", "a.", "p\u{e9}", &"n".repeat(129)] {
            assert!(check_name(name).is_err(), "{name}");
        }
    }
}
