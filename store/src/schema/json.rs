//! Payloads to JSON and back by the schema alone, without loss.
//!
//! JSON has one kind of number, so what it cannot hold becomes a string: integers beyond 2^53, `"NaN"` (`"NaN:7fc00001"`
//! with its bits unless it is the usual one), `"inf"`, `"-inf"`, and bytes as base64. On the way back an integer may
//! always be a string of digits.

use base64::Engine;
use base64::engine::general_purpose::STANDARD as BASE64;
use serde_json::{Map, Value as Json};

use super::layout::{Field, Scalar, Struct, Type};
use super::payload::{Input, Integers, Output, Value, narrowed, shortest};
use super::range::Range;
use super::{Body, Schema, SchemaError};

/// Prints a payload.
pub(super) fn to_json(schema: &Schema, payload: &[u8]) -> Result<Json, SchemaError> {
    let (ty, integers) = match &schema.body {
        Body::Plain(ty) => (ty, Integers::Fixed),
        Body::Bincode(ty) => (ty, Integers::Variable),
        Body::Raw { format, .. } if format == "json" => {
            return serde_json::from_slice(payload).map_err(|fault| SchemaError::Payload {
                field: ROOT.to_owned(),
                fault: format!("not JSON: {fault}"),
            });
        }
        Body::Raw { .. } => return Ok(Json::String(BASE64.encode(payload))),
    };
    let mut input = Input::new(payload, integers);
    let value = read(ty, &mut input)?;
    input.end().map_err(in_payload)?;
    Ok(value)
}

/// Makes a payload.
pub(super) fn from_json(schema: &Schema, value: &Json) -> Result<Vec<u8>, SchemaError> {
    let (ty, integers) = match &schema.body {
        Body::Plain(ty) => (ty, Integers::Fixed),
        Body::Bincode(ty) => (ty, Integers::Variable),
        Body::Raw { format, .. } if format == "json" => return Ok(value.to_string().into_bytes()),
        Body::Raw { .. } => return base64_bytes(value),
    };
    let mut output = Output::new(integers);
    write(ty, None, value, &mut output)?;
    Ok(output.into_bytes())
}

fn read(ty: &Type, input: &mut Input<'_>) -> Result<Json, SchemaError> {
    match ty {
        Type::Scalar(scalar) => input
            .scalar(*scalar)
            .map(scalar_to_json)
            .map_err(in_payload),
        Type::String => {
            let bytes = input.bytes().map_err(in_payload)?;
            let text = std::str::from_utf8(bytes);
            text.map(|text| Json::String(text.to_owned()))
                .map_err(|_invalid| in_payload("not UTF-8".to_owned()))
        }
        Type::Bytes => {
            let bytes = input.bytes().map_err(in_payload)?;
            Ok(Json::String(BASE64.encode(bytes)))
        }
        Type::Array(element, count) => read_elements(element, u64::from(*count), input),
        Type::Vector(element) => {
            let count = input.length().map_err(in_payload)?;
            read_elements(element, u64::try_from(count).unwrap_or(u64::MAX), input)
        }
        Type::Option(value) => match input.flag().map_err(in_payload)? {
            true => read(value, input),
            false => Ok(Json::Null),
        },
        Type::Struct(shape) => {
            let mut object = Map::new();
            for field in &shape.fields {
                let value = read(&field.ty, input).map_err(|e| e.within(&field.name))?;
                object.insert(field.name.clone(), value);
            }
            Ok(Json::Object(object))
        }
        Type::Enum(names) => {
            let variant = input.variant().map_err(in_payload)?;
            let name = usize::try_from(variant).ok().and_then(|at| names.get(at));
            name.map(|name| Json::String(name.clone()))
                .ok_or_else(|| in_payload(format!("no name has number {variant} in {ty}")))
        }
    }
}

fn read_elements(element: &Type, count: u64, input: &mut Input<'_>) -> Result<Json, SchemaError> {
    let mut elements = Vec::new();
    for at in 0..count {
        // Every element takes at least one byte, so the payload bounds the work whatever the count says.
        elements.push(read(element, input).map_err(|e| e.within(&format!("[{at}]")))?);
    }
    Ok(Json::Array(elements))
}

fn scalar_to_json(value: Value) -> Json {
    match value {
        Value::Unsigned(value) if value > EXACT_MAX => Json::String(value.to_string()),
        Value::Unsigned(value) => Json::from(value),
        Value::Signed(value) if value.unsigned_abs() > EXACT_MAX => Json::String(value.to_string()),
        Value::Signed(value) => Json::from(value),
        Value::Bool(value) => Json::Bool(value),
        Value::F64(value) if value.is_nan() && value.to_bits() != f64::NAN.to_bits() => {
            Json::String(format!("NaN:{:016x}", value.to_bits()))
        }
        Value::F64(value) if value.is_finite() => Json::from(value),
        Value::F64(value) => Json::String(value.to_string()),
        Value::F32(value) if value.is_nan() && value.to_bits() != f32::NAN.to_bits() => {
            Json::String(format!("NaN:{:08x}", value.to_bits()))
        }
        Value::F32(value) if value.is_finite() => Json::from(shortest(value)),
        Value::F32(value) => Json::String(value.to_string()),
    }
}

fn write(
    ty: &Type,
    range: Option<&Range>,
    value: &Json,
    output: &mut Output,
) -> Result<(), SchemaError> {
    match (ty, value) {
        (Type::Scalar(scalar), _) => {
            let number = scalar_from_json(*scalar, value).ok_or_else(|| mismatch(ty, value))?;
            check_range(range, number, value)?;
            output.scalar(*scalar, number);
            Ok(())
        }
        (Type::String, Json::String(text)) => {
            output.bytes(text.as_bytes());
            Ok(())
        }
        (Type::Bytes, _) => {
            output.bytes(&base64_bytes(value)?);
            Ok(())
        }
        (Type::Array(element, count), Json::Array(elements)) => {
            if u32::try_from(elements.len()) != Ok(*count) {
                return Err(mismatch(ty, value));
            }
            write_elements(element, range, elements, output)
        }
        (Type::Vector(element), Json::Array(elements)) => {
            output.length(elements.len());
            write_elements(element, range, elements, output)
        }
        (Type::Option(_), Json::Null) => {
            output.flag(false);
            Ok(())
        }
        (Type::Option(inner), _) => {
            output.flag(true);
            write(inner, range, value, output)
        }
        (Type::Struct(shape), Json::Object(object)) => write_fields(shape, object, output),
        (Type::Enum(names), Json::String(name)) => {
            let variant = names.iter().position(|known| known == name);
            // A variant is spelled as a length is.
            output.length(variant.ok_or_else(|| mismatch(ty, value))?);
            Ok(())
        }
        _ => Err(mismatch(ty, value)),
    }
}

fn write_elements(
    element: &Type,
    range: Option<&Range>,
    values: &[Json],
    output: &mut Output,
) -> Result<(), SchemaError> {
    values.iter().enumerate().try_for_each(|(at, value)| {
        write(element, range, value, output).map_err(|e| e.within(&format!("[{at}]")))
    })
}

fn write_fields(
    shape: &Struct,
    object: &Map<String, Json>,
    output: &mut Output,
) -> Result<(), SchemaError> {
    let known = |name: &String| shape.fields.iter().any(|field| field.name == *name);
    if let Some(name) = object.keys().find(|name| !known(name)) {
        return Err(SchemaError::Unknown {
            field: name.clone(),
        });
    }
    for Field {
        name, ty, range, ..
    } in &shape.fields
    {
        let value = object.get(name).ok_or_else(|| SchemaError::Missing {
            field: name.clone(),
        })?;
        write(ty, range.as_ref(), value, output).map_err(|e| e.within(name))?;
    }
    Ok(())
}

fn scalar_from_json(scalar: Scalar, value: &Json) -> Option<Value> {
    match scalar {
        Scalar::Bool => value.as_bool().map(Value::Bool),
        Scalar::F64 => f64_from_json(value).map(Value::F64),
        Scalar::F32 => f32_from_json(value).map(Value::F32),
        Scalar::U8 | Scalar::U16 | Scalar::U32 | Scalar::U64 => {
            let digits = value.as_str().and_then(|text| text.parse().ok());
            let integer = digits.or_else(|| value.as_u64())?;
            (integer <= u64::MAX >> unused_bits(scalar)).then_some(Value::Unsigned(integer))
        }
        Scalar::I8 | Scalar::I16 | Scalar::I32 | Scalar::I64 => {
            let digits = value.as_str().and_then(|text| text.parse().ok());
            let integer = digits.or_else(|| value.as_i64())?;
            let unused = unused_bits(scalar);
            (i64::MIN >> unused..=i64::MAX >> unused)
                .contains(&integer)
                .then_some(Value::Signed(integer))
        }
    }
}

fn f64_from_json(value: &Json) -> Option<f64> {
    let Some(text) = value.as_str() else {
        return value.as_f64();
    };
    match nan_bits(text) {
        Some(bits) => Some(f64::from_bits(bits)).filter(|float| float.is_nan()),
        None => not_finite(text),
    }
}

fn f32_from_json(value: &Json) -> Option<f32> {
    let Some(text) = value.as_str() else {
        let float = value.as_f64().map(narrowed);
        return float.filter(|float| float.is_finite());
    };
    match nan_bits(text) {
        Some(bits) => {
            let bits = u32::try_from(bits).ok()?;
            Some(f32::from_bits(bits)).filter(|float| float.is_nan())
        }
        None => not_finite(text).map(narrowed),
    }
}

/// Bits by which an integer type is narrower than 64.
fn unused_bits(scalar: Scalar) -> u32 {
    64_u32.saturating_sub(scalar.size_bytes().saturating_mul(8))
}

fn not_finite(text: &str) -> Option<f64> {
    match text {
        "NaN" => Some(f64::NAN),
        "inf" => Some(f64::INFINITY),
        "-inf" => Some(f64::NEG_INFINITY),
        _ => None,
    }
}

/// The bits of a NaN that is not the usual one.
fn nan_bits(text: &str) -> Option<u64> {
    u64::from_str_radix(text.strip_prefix("NaN:")?, 16).ok()
}

fn check_range(range: Option<&Range>, number: Value, value: &Json) -> Result<(), SchemaError> {
    match (range, number.number()) {
        (Some(range), Some(number)) if !range.contains(number) => Err(SchemaError::OutOfRange {
            field: ROOT.to_owned(),
            value: shown(value),
            range: *range,
        }),
        _ => Ok(()),
    }
}

fn base64_bytes(value: &Json) -> Result<Vec<u8>, SchemaError> {
    value
        .as_str()
        .and_then(|text| BASE64.decode(text).ok())
        .ok_or_else(|| SchemaError::Mismatch {
            field: ROOT.to_owned(),
            expected: "bytes as base64".to_owned(),
            found: shown(value),
        })
}

fn mismatch(ty: &Type, value: &Json) -> SchemaError {
    let found = match value {
        Json::Array(elements) => format!("an array of {}", elements.len()),
        Json::Object(_) => "an object".to_owned(),
        Json::Null | Json::Bool(_) | Json::Number(_) | Json::String(_) => shown(value),
    };
    SchemaError::Mismatch {
        field: ROOT.to_owned(),
        expected: ty.to_string(),
        found,
    }
}

/// A value for an error message, cut where it gets long.
fn shown(value: &Json) -> String {
    let text = value.to_string();
    match text.char_indices().nth(SHOWN_MAX_CHARS) {
        Some((end, _)) => format!("{}…", text.get(..end).unwrap_or_default()),
        None => text,
    }
}

fn in_payload(fault: String) -> SchemaError {
    SchemaError::Payload {
        field: ROOT.to_owned(),
        fault,
    }
}

impl SchemaError {
    /// The same fault seen from one level up: the path of its field begins with `outer`, a name or an index in brackets.
    fn within(mut self, outer: &str) -> Self {
        match &mut self {
            Self::Payload { field, .. }
            | Self::Mismatch { field, .. }
            | Self::OutOfRange { field, .. }
            | Self::Missing { field }
            | Self::Unknown { field } => {
                *field = match field.as_str() {
                    ROOT => outer.to_owned(),
                    inner if inner.starts_with('[') => format!("{outer}{inner}"),
                    inner => format!("{outer}.{inner}"),
                };
            }
            Self::Text { .. } | Self::Layout { .. } | Self::Length { .. } | Self::Codec(_) => {}
        }
        self
    }
}

/// Name of the whole value in an error, where there is no field.
const ROOT: &str = "(value)";
/// Largest magnitude to which every JSON reader keeps integers exact.
const EXACT_MAX: u64 = 1 << 53;
/// Longest value in an error message, characters.
const SHOWN_MAX_CHARS: usize = 40;
