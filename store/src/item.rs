//! What a Rust type must say to be the type of an item: its schema, and how a value becomes bytes and comes back.
//!
//! `#[derive(ddx_store::Item)]` writes all of it. Scalars, fixed arrays of scalars, `String` and `Vec<u8>` are items as
//! they are.
//!
//! # Safety of plain types
//!
//! A guard forms `&T` over memory that another process wrote, and the functions in [`plain`] turn values into bytes and
//! back. Both rest on [`Plain`]: the type is valid under every bit pattern, has no padding, and its layout is fixed
//! (`repr(C)`, little-endian). This file implements it for the numbers and their arrays; the derive implements it for a
//! struct only beside assertions that fail to compile where it would not hold.
#![expect(
    unsafe_code,
    reason = "the contract of plain types, and the two copies that rest on it"
)]

use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::schema::{Encoding, Scalar, Schema, SchemaError, Type};

/// A type whose values are the samples of an item.
///
/// ```
/// use ddx_store::Item;
///
/// #[derive(Clone, Copy, Item)]
/// #[repr(C)]
/// struct Pose {
///     #[ddx(unit = "m")]
///     x: f64,
///     #[ddx(unit = "rad", range = "-3.15..3.15")]
///     heading: f64,
/// }
///
/// let mut bytes = Vec::new();
/// Pose { x: 1.0, heading: 0.5 }.encode(&mut bytes)?;
/// assert_eq!(Pose::schema().to_json(&bytes)?.to_string(), r#"{"x":1.0,"heading":0.5}"#);
/// # Ok::<(), ddx_store::SchemaError>(())
/// ```
pub trait Item: Sized {
    /// Describes the type. Built anew at each call: call it once, when the item is opened.
    fn schema() -> Schema;

    /// Appends this value's payload to `out`. Fails only where the encoding cannot express the value.
    fn encode(&self, out: &mut Vec<u8>) -> Result<(), SchemaError>;

    /// This value's payload where that is there already, as of a plain type, which is its own: spares a copy.
    fn as_payload(&self) -> Option<&[u8]> {
        None
    }

    /// Reads a value that takes up all of `payload`, which may hold anything.
    fn decode(payload: &[u8]) -> Result<Self, SchemaError>;
}

/// A type that a field of an item may have.
#[diagnostic::on_unimplemented(
    message = "`{Self}` has no type in a schema",
    label = "not a type that every language can read",
    note = "use fixed-width numbers, `bool`, `String`, `Vec`, `Option`, arrays, or a type that derives `ddx_store::Item`"
)]
pub trait Typed {
    /// The type as a schema spells it.
    fn ty() -> Type;
}

/// A type that is its own payload: every reader may look at the writer's memory as a `T`.
///
/// The derive implements it where it holds, and otherwise does not compile. A byte of padding:
///
/// ```compile_fail,E0080
/// #[derive(Clone, Copy, ddx_store::Item)]
/// #[repr(C)]
/// struct Wheel { ordinal: u8, speed: f32 } // Error: padding between `ordinal` and `speed`.
/// ```
///
/// A field that is not valid under every bit pattern:
///
/// ```compile_fail,E0277
/// #[derive(Clone, Copy, ddx_store::Item)]
/// #[repr(C)]
/// struct Wheel { locked: bool } // Error: use `u8` for a `bool`.
/// ```
///
/// Both corrected:
///
/// ```
/// #[derive(Clone, Copy, ddx_store::Item)]
/// #[repr(C)]
/// struct Wheel { speed: f32, ordinal: u8, locked: u8, _pad: [u8; 2] }
/// ```
///
/// # Safety
///
/// Every bit pattern of `size_of::<Self>()` bytes is a valid value, no byte of it is padding, it holds no pointer, and
/// its layout is that of its schema: `repr(C)`, little-endian.
#[diagnostic::on_unimplemented(
    message = "`{Self}` cannot be read in place from memory that another program wrote",
    label = "not a plain type",
    note = "a plain item holds numbers, fixed arrays and structs of them: use `u8` for a `bool`, or `#[ddx(encoding = \"bincode\")]`"
)]
pub unsafe trait Plain: Item + Typed + Copy + Send + Sync + 'static {}

/// Values of plain types as bytes and back.
pub mod plain {
    use super::Plain;
    use crate::schema::SchemaError;

    /// The bytes of `value`: its payload.
    pub fn bytes<T: Plain>(value: &T) -> &[u8] {
        let start = std::ptr::from_ref(value).cast::<u8>();
        // SAFETY: `start` is valid for `size_of::<T>()` reads as long as `value` is borrowed, all of these bytes are
        // initialised because a plain type has no padding, and `u8` needs no alignment.
        unsafe { std::slice::from_raw_parts(start, size_of::<T>()) }
    }

    /// Copies a value out of `payload`, which needs no alignment. Fails when the length is not the type's size.
    pub fn read<T: Plain>(payload: &[u8]) -> Result<T, SchemaError> {
        if payload.len() != size_of::<T>() {
            return Err(SchemaError::Length {
                expected: size_of::<T>(),
                found: payload.len(),
            });
        }
        let start = payload.as_ptr().cast::<T>();
        // SAFETY: `start` is valid for `size_of::<T>()` reads by the check above, the read asks for no alignment, and
        // every bit pattern is a valid `T`.
        Ok(unsafe { start.read_unaligned() })
    }

    /// The value in place; `None` when the length or the alignment of `payload` is not the type's.
    pub fn view<T: Plain>(payload: &[u8]) -> Option<&T> {
        let start = payload.as_ptr().cast::<T>();
        if payload.len() != size_of::<T>() || !start.is_aligned() {
            return None;
        }
        // SAFETY: `start` is aligned and valid for `size_of::<T>()` reads as long as `payload` is borrowed, and every
        // bit pattern is a valid `T`.
        Some(unsafe { &*start })
    }

    /// The value in place, to be changed; `None` when the length or the alignment of `payload` is not the type's.
    pub fn view_mut<T: Plain>(payload: &mut [u8]) -> Option<&mut T> {
        let start = payload.as_mut_ptr().cast::<T>();
        if payload.len() != size_of::<T>() || !start.is_aligned() {
            return None;
        }
        // SAFETY: as for `view`, with `payload` borrowed alone; no byte of a `T` is padding, so all stay initialised.
        Some(unsafe { &mut *start })
    }
}

/// Appends the bincode encoding of `value`: what the derive calls for `encoding = "bincode"`.
pub fn encode_bincode<T: Serialize>(value: &T, out: &mut Vec<u8>) -> Result<(), SchemaError> {
    Ok(ddx_wire::codec::encode(value, out)?)
}

/// Reads a bincode value that takes up all of `payload`: what the derive calls for `encoding = "bincode"`.
pub fn decode_bincode<T: DeserializeOwned>(payload: &[u8]) -> Result<T, SchemaError> {
    Ok(ddx_wire::codec::decode_sample(payload)?)
}

macro_rules! plain_scalars {
    ($($rust:ty => $scalar:ident),+ $(,)?) => {$(
        impl Typed for $rust {
            fn ty() -> Type {
                Type::Scalar(Scalar::$scalar)
            }
        }

        impl Item for $rust {
            fn schema() -> Schema {
                Schema::of::<Self>(stringify!($rust), Encoding::Plain)
            }

            fn encode(&self, out: &mut Vec<u8>) -> Result<(), SchemaError> {
                out.extend_from_slice(plain::bytes(self));
                Ok(())
            }

            fn as_payload(&self) -> Option<&[u8]> {
                Some(plain::bytes(self))
            }

            fn decode(payload: &[u8]) -> Result<Self, SchemaError> {
                plain::read(payload)
            }
        }

        // SAFETY: a number has no padding, no pointer and no invalid bit pattern; its schema states its width.
        unsafe impl Plain for $rust {}
    )+};
}

plain_scalars! {
    u8 => U8, u16 => U16, u32 => U32, u64 => U64,
    i8 => I8, i16 => I16, i32 => I32, i64 => I64,
    f32 => F32, f64 => F64,
}

impl<T: Typed, const N: usize> Typed for [T; N] {
    fn ty() -> Type {
        Type::array(T::ty(), N)
    }
}

impl<T: Plain, const N: usize> Item for [T; N] {
    fn schema() -> Schema {
        Schema::of::<Self>("array", Encoding::Plain)
    }

    fn encode(&self, out: &mut Vec<u8>) -> Result<(), SchemaError> {
        out.extend_from_slice(plain::bytes(self));
        Ok(())
    }

    fn as_payload(&self) -> Option<&[u8]> {
        Some(plain::bytes(self))
    }

    fn decode(payload: &[u8]) -> Result<Self, SchemaError> {
        plain::read(payload)
    }
}

// SAFETY: an array has no bytes but those of its elements, which are plain.
unsafe impl<T: Plain, const N: usize> Plain for [T; N] {}

impl Typed for bool {
    fn ty() -> Type {
        Type::Scalar(Scalar::Bool)
    }
}

impl Typed for String {
    fn ty() -> Type {
        Type::String
    }
}

impl<T: Typed> Typed for Vec<T> {
    fn ty() -> Type {
        Type::vector(T::ty())
    }
}

impl<T: Typed> Typed for Option<T> {
    fn ty() -> Type {
        Type::option(T::ty())
    }
}

/// One byte, 0 or 1, in the bincode encoding: a byte that another program wrote may be neither.
impl Item for bool {
    fn schema() -> Schema {
        Schema::of::<Self>("bool", Encoding::Bincode)
    }

    fn encode(&self, out: &mut Vec<u8>) -> Result<(), SchemaError> {
        encode_bincode(self, out)
    }

    fn decode(payload: &[u8]) -> Result<Self, SchemaError> {
        decode_bincode(payload)
    }
}

impl Item for String {
    fn schema() -> Schema {
        Schema::of::<Self>("string", Encoding::Bincode)
    }

    fn encode(&self, out: &mut Vec<u8>) -> Result<(), SchemaError> {
        encode_bincode(self, out)
    }

    fn decode(payload: &[u8]) -> Result<Self, SchemaError> {
        decode_bincode(payload)
    }
}

/// Bytes as they are, of which the schema says nothing.
impl Item for Vec<u8> {
    fn schema() -> Schema {
        Schema::bytes()
    }

    fn encode(&self, out: &mut Vec<u8>) -> Result<(), SchemaError> {
        out.extend_from_slice(self);
        Ok(())
    }

    fn as_payload(&self) -> Option<&[u8]> {
        Some(self)
    }

    fn decode(payload: &[u8]) -> Result<Self, SchemaError> {
        Ok(payload.to_vec())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plain_value_is_its_own_little_endian_payload() {
        let mut payload = vec![0xff];
        [1_u16, 0x0203].encode(&mut payload).unwrap();

        assert_eq!(payload, [0xff, 1, 0, 3, 2]);
        assert_eq!(<[u16; 2]>::decode(&payload[1..]).unwrap(), [1, 0x0203]);
    }

    #[test]
    fn a_payload_of_another_length_is_refused() {
        let fault = u32::decode(&[0; 5]).unwrap_err();

        assert_eq!(fault.to_string(), "payload has 5 bytes, 4 expected");
    }

    #[test]
    fn a_string_is_length_and_text_and_bytes_are_themselves() {
        let (mut text, mut bytes) = (Vec::new(), Vec::new());
        "hi".to_owned().encode(&mut text).unwrap();
        b"hi".to_vec().encode(&mut bytes).unwrap();

        assert_eq!(text, [2, b'h', b'i']);
        assert_eq!(String::decode(&text).unwrap(), "hi");
        assert_eq!(bytes, b"hi");
        assert_eq!(Vec::<u8>::decode(&bytes).unwrap(), b"hi");
    }
}
