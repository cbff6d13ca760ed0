//! Values in the bytes of a payload, in the two encodings that a schema can describe.
//!
//! A plain payload has no gap, so both encodings are a walk over the fields in order and differ only in how they spell
//! an integer: at its width, or as bincode's variable-length integer. That is one byte up to 250, else a mark (251, 252
//! or 253) and 2, 4 or 8 little-endian bytes; signed integers are zigzag-folded first. Lengths and enum variants are
//! unsigned integers, an option begins with 0 or 1, and `u8`, `i8`, `bool` and floats always stand at their width.

use super::layout::Scalar;
use super::range::Number;

/// One number or bool with its exact bits.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Value {
    Unsigned(u64),
    Signed(i64),
    F32(f32),
    F64(f64),
    Bool(bool),
}

impl Value {
    /// The value as a bound can be compared with it; a bool has none.
    pub(super) fn number(self) -> Option<Number> {
        match self {
            Self::Unsigned(value) => Some(Number::Integer(i128::from(value))),
            Self::Signed(value) => Some(Number::Integer(i128::from(value))),
            Self::F32(value) => Some(Number::Float(shortest(value))),
            Self::F64(value) => Some(Number::Float(value)),
            Self::Bool(_) => None,
        }
    }
}

/// How integers are spelled.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Integers {
    /// At their width: the plain encoding.
    Fixed,
    /// bincode's variable-length integers.
    Variable,
}

/// A payload that is read from front to back; a fault is a phrase without the field's name.
pub(super) struct Input<'a> {
    rest: &'a [u8],
    integers: Integers,
}

impl<'a> Input<'a> {
    pub(super) fn new(payload: &'a [u8], integers: Integers) -> Self {
        Self {
            rest: payload,
            integers,
        }
    }

    pub(super) fn scalar(&mut self, scalar: Scalar) -> Result<Value, String> {
        Ok(match scalar {
            Scalar::U8 => Value::Unsigned(u64::from(self.byte()?)),
            Scalar::I8 => Value::Signed(i64::from(i8::from_le_bytes(self.take()?))),
            Scalar::U16 | Scalar::U32 | Scalar::U64 => {
                Value::Unsigned(self.unsigned(scalar.size_bytes())?)
            }
            Scalar::I16 | Scalar::I32 | Scalar::I64 => {
                Value::Signed(self.signed(scalar.size_bytes())?)
            }
            Scalar::F32 => Value::F32(f32::from_le_bytes(self.take()?)),
            Scalar::F64 => Value::F64(f64::from_le_bytes(self.take()?)),
            Scalar::Bool => Value::Bool(self.flag()?),
        })
    }

    /// A count of elements, each of which takes at least one of the bytes that are left.
    pub(super) fn length(&mut self) -> Result<usize, String> {
        let claimed = self.variable(8)?;
        usize::try_from(claimed)
            .ok()
            .filter(|length| *length <= self.rest.len())
            .ok_or_else(|| {
                format!(
                    "length {claimed} is stated, {} bytes are left",
                    self.rest.len()
                )
            })
    }

    pub(super) fn bytes(&mut self) -> Result<&'a [u8], String> {
        let length = self.length()?;
        let (bytes, rest) = self.rest.split_at_checked(length).ok_or_else(short)?;
        self.rest = rest;
        Ok(bytes)
    }

    pub(super) fn variant(&mut self) -> Result<u64, String> {
        self.variable(4)
    }

    /// A bool, or whether an option holds a value.
    pub(super) fn flag(&mut self) -> Result<bool, String> {
        match self.byte()? {
            0 => Ok(false),
            1 => Ok(true),
            other => Err(format!("0 or 1 expected, {other} found")),
        }
    }

    pub(super) fn end(&self) -> Result<(), String> {
        match self.rest.len() {
            0 => Ok(()),
            left => Err(format!("{left} bytes are left after the value")),
        }
    }

    fn unsigned(&mut self, size_bytes: u32) -> Result<u64, String> {
        match self.integers {
            Integers::Variable => self.variable(size_bytes),
            Integers::Fixed => self.fixed(size_bytes),
        }
    }

    fn signed(&mut self, size_bytes: u32) -> Result<i64, String> {
        match self.integers {
            Integers::Variable => {
                let folded = self.variable(size_bytes)?;
                let half = (folded >> 1).cast_signed();
                Ok(if folded & 1 == 1 { !half } else { half })
            }
            Integers::Fixed => Ok(match size_bytes {
                2 => i64::from(i16::from_le_bytes(self.take()?)),
                4 => i64::from(i32::from_le_bytes(self.take()?)),
                _ => i64::from_le_bytes(self.take()?),
            }),
        }
    }

    fn fixed(&mut self, size_bytes: u32) -> Result<u64, String> {
        Ok(match size_bytes {
            2 => u64::from(u16::from_le_bytes(self.take()?)),
            4 => u64::from(u32::from_le_bytes(self.take()?)),
            _ => u64::from_le_bytes(self.take()?),
        })
    }

    /// A variable-length integer of a type of `size_bytes`; like bincode, a longer spelling than needed is read.
    fn variable(&mut self, size_bytes: u32) -> Result<u64, String> {
        let width = match self.byte()? {
            MARK_16 => 2,
            MARK_32 => 4,
            MARK_64 => 8,
            mark @ (254 | 255) => return Err(format!("{mark} does not begin an integer")),
            small => return Ok(u64::from(small)),
        };
        if width > size_bytes {
            let bits = size_bytes.saturating_mul(8);
            return Err(format!(
                "integer of {bits} bits expected, a longer one found"
            ));
        }
        self.fixed(width)
    }

    fn byte(&mut self) -> Result<u8, String> {
        self.take().map(|[byte]: [u8; 1]| byte)
    }

    fn take<const N: usize>(&mut self) -> Result<[u8; N], String> {
        let (bytes, rest) = self.rest.split_first_chunk().ok_or_else(short)?;
        self.rest = rest;
        Ok(*bytes)
    }
}

/// A payload that is written from front to back.
pub(super) struct Output {
    bytes: Vec<u8>,
    integers: Integers,
}

impl Output {
    pub(super) fn new(integers: Integers) -> Self {
        Self {
            bytes: Vec::new(),
            integers,
        }
    }

    /// Writes `value`, which is of the kind and within the bounds of `scalar`.
    pub(super) fn scalar(&mut self, scalar: Scalar, value: Value) {
        let fixed = self.integers == Integers::Fixed || scalar.size_bytes() == 1;
        match value {
            Value::Unsigned(value) if fixed => self.fixed(value.to_le_bytes(), scalar.size_bytes()),
            Value::Unsigned(value) => self.variable(value),
            Value::Signed(value) if fixed => self.fixed(value.to_le_bytes(), scalar.size_bytes()),
            Value::Signed(value) => self.variable(((value << 1) ^ (value >> 63)).cast_unsigned()),
            Value::F32(value) => self.bytes.extend(value.to_le_bytes()),
            Value::F64(value) => self.bytes.extend(value.to_le_bytes()),
            Value::Bool(value) => self.flag(value),
        }
    }

    pub(super) fn length(&mut self, length: usize) {
        self.variable(u64::try_from(length).unwrap_or(u64::MAX));
    }

    pub(super) fn bytes(&mut self, bytes: &[u8]) {
        self.length(bytes.len());
        self.bytes.extend_from_slice(bytes);
    }

    pub(super) fn flag(&mut self, flag: bool) {
        self.bytes.push(u8::from(flag));
    }

    pub(super) fn into_bytes(self) -> Vec<u8> {
        self.bytes
    }

    fn fixed(&mut self, bytes: [u8; 8], size_bytes: u32) {
        let size = usize::try_from(size_bytes).unwrap_or(bytes.len());
        self.bytes.extend(bytes.iter().take(size));
    }

    fn variable(&mut self, value: u64) {
        if let Ok(small) = u8::try_from(value)
            && small < MARK_16
        {
            self.bytes.push(small);
        } else if let Ok(value) = u16::try_from(value) {
            self.bytes.push(MARK_16);
            self.bytes.extend(value.to_le_bytes());
        } else if let Ok(value) = u32::try_from(value) {
            self.bytes.push(MARK_32);
            self.bytes.extend(value.to_le_bytes());
        } else {
            self.bytes.push(MARK_64);
            self.bytes.extend(value.to_le_bytes());
        }
    }
}

/// The double with the fewest digits that rounds to `value`: 0.1 rather than 0.10000000149011612.
pub(super) fn shortest(value: f32) -> f64 {
    match value.to_string().parse() {
        Ok(short) if narrowed(short).to_bits() == value.to_bits() => short,
        Ok(_) | Err(_) => f64::from(value),
    }
}

/// The nearest `f32`.
#[expect(
    clippy::cast_possible_truncation,
    reason = "rounding to the nearest f32 is what is asked for"
)]
pub(super) fn narrowed(value: f64) -> f32 {
    value as f32
}

fn short() -> String {
    "the payload ends here".to_owned()
}

/// First byte of an integer of 16 bits.
const MARK_16: u8 = 251;
/// First byte of an integer of 32 bits.
const MARK_32: u8 = 252;
/// First byte of an integer of 64 bits.
const MARK_64: u8 = 253;

#[cfg(test)]
mod tests {
    use super::*;

    fn written(integers: Integers, scalar: Scalar, value: Value) -> Vec<u8> {
        let mut output = Output::new(integers);
        output.scalar(scalar, value);
        output.into_bytes()
    }

    #[test]
    fn integers_take_the_fewest_bytes_that_bincode_knows() {
        let cases: [(Scalar, Value, &[u8]); 9] = [
            (Scalar::U64, Value::Unsigned(250), &[250]),
            (Scalar::U64, Value::Unsigned(251), &[251, 251, 0]),
            (Scalar::U32, Value::Unsigned(65_535), &[251, 255, 255]),
            (Scalar::U32, Value::Unsigned(65_536), &[252, 0, 0, 1, 0]),
            (
                Scalar::U64,
                Value::Unsigned(1 << 32),
                &[253, 0, 0, 0, 0, 1, 0, 0, 0],
            ),
            (Scalar::I16, Value::Signed(-1), &[1]),
            (Scalar::I32, Value::Signed(125), &[250]),
            (Scalar::U8, Value::Unsigned(255), &[255]),
            (Scalar::I8, Value::Signed(-1), &[255]),
        ];
        for (scalar, value, bytes) in cases {
            assert_eq!(written(Integers::Variable, scalar, value), bytes);
            let mut input = Input::new(bytes, Integers::Variable);
            assert_eq!(input.scalar(scalar), Ok(value));
            assert_eq!(input.end(), Ok(()));
        }
    }

    #[test]
    fn plain_integers_stand_at_their_width() {
        let bytes = written(Integers::Fixed, Scalar::I16, Value::Signed(-2));

        assert_eq!(bytes, [0xfe, 0xff]);
        let read = Input::new(&bytes, Integers::Fixed).scalar(Scalar::I16);
        assert_eq!(read, Ok(Value::Signed(-2)));
    }

    #[test]
    fn an_integer_wider_than_its_type_is_refused() {
        let wide = [252, 1, 0, 0, 0];

        let fault = Input::new(&wide, Integers::Variable).scalar(Scalar::U16);
        assert_eq!(
            fault.unwrap_err(),
            "integer of 16 bits expected, a longer one found"
        );
        let mark = Input::new(&[254, 0], Integers::Variable).scalar(Scalar::U64);
        assert_eq!(mark.unwrap_err(), "254 does not begin an integer");
    }
}
