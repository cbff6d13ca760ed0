//! The domain key: thirty-two random bytes that make a host a member.

use std::fmt;

use ring::aead::{AES_256_GCM, LessSafeKey, UnboundKey};
use ring::hkdf::{HKDF_SHA256, KeyType, Prk, Salt};

use crate::header::{KeyId, Purpose};
use crate::{HostId, Incarnation, Tag};

/// Secret shared by the hosts of one domain. Whoever holds it is a member, and could pose as any other.
///
/// Its text form is 64 hexadecimal digits. `Debug` shows the public [`KeyId`] only, and the bytes are cleared on drop.
#[derive(Clone, PartialEq, Eq)]
pub struct DomainKey([u8; 32]);

/// Why a text is not a domain key. Never quotes the text, which may be nearly a key.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum KeyError {
    /// The text has another length.
    #[error("a domain key has 64 hexadecimal digits, this one has {found} characters")]
    Length {
        /// Characters found, white space around them excluded.
        found: usize,
    },
    /// A character is no hexadecimal digit.
    #[error("a domain key has hexadecimal digits only, character {position} is none")]
    Digit {
        /// Position of the first such character, from 1.
        position: usize,
    },
}

impl DomainKey {
    /// Makes a key of 32 bytes, which are to be random.
    pub fn from_bytes(bytes: [u8; 32]) -> Self {
        Self(bytes)
    }

    /// Reads what [`DomainKey::to_text`] writes; white space around it is ignored.
    ///
    /// # Errors
    /// [`KeyError`] names the length found or the first wrong character.
    pub fn parse(text: &str) -> Result<Self, KeyError> {
        let text = text.trim();
        let found = text.chars().count();
        if found != 64 {
            return Err(KeyError::Length { found });
        }
        let mut key = Self([0; 32]);
        let mut digits = (1_usize..).zip(text.chars());
        for byte in &mut key.0 {
            for _ in 0..2 {
                let (position, digit) = digits.next().ok_or(KeyError::Length { found })?;
                let value = digit.to_digit(16).ok_or(KeyError::Digit { position })?;
                let value = u8::try_from(value).map_err(|_| KeyError::Digit { position })?;
                *byte = (*byte << 4) | value;
            }
        }
        Ok(key)
    }

    /// The text form, 64 lower-case hexadecimal digits: the secret itself.
    pub fn to_text(&self) -> String {
        self.0.iter().map(|byte| format!("{byte:02x}")).collect()
    }

    /// The public short name, in the clear in each datagram.
    pub fn id(&self) -> KeyId {
        let mut id = [0; 2];
        self.expand(&[b"key id"], &mut id);
        KeyId(u16::from_le_bytes(id))
    }

    /// The key of one incarnation of a host for one purpose.
    pub(crate) fn derive(
        &self,
        host: HostId,
        incarnation: Incarnation,
        purpose: Purpose,
    ) -> LessSafeKey {
        let label: &[u8] = match purpose {
            Purpose::Control => b"control",
            Purpose::Data => b"data",
            Purpose::Hello => return self.derive_hello(Tag::of(host, incarnation)),
        };
        let ordinal = incarnation.ordinal.to_le_bytes();
        let random = incarnation.random.to_le_bytes();
        self.sealing_key(&[label, &host.0, &ordinal, &random])
    }

    /// The key of the hello lane, which a stranger's tag is enough to find.
    pub(crate) fn derive_hello(&self, sender: Tag) -> LessSafeKey {
        self.sealing_key(&[b"hello", &sender.0.to_le_bytes()])
    }

    fn sealing_key(&self, info: &[&[u8]]) -> LessSafeKey {
        let mut bytes = [0; 32];
        self.expand(info, &mut bytes);
        let key = UnboundKey::new(&AES_256_GCM, &bytes).expect("the key has the cipher's length");
        clear(&mut bytes);
        LessSafeKey::new(key)
    }

    fn expand(&self, info: &[&[u8]], out: &mut [u8]) {
        let prk: Prk = Salt::new(HKDF_SHA256, b"ddx domain key v1").extract(&self.0);
        prk.expand(info, OutLength(out.len()))
            .and_then(|okm| okm.fill(out))
            .expect("the output is shorter than 255 hashes");
    }
}

impl Drop for DomainKey {
    fn drop(&mut self) {
        clear(&mut self.0);
    }
}

impl fmt::Debug for DomainKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "DomainKey(id {:04x})", self.id().0)
    }
}

struct OutLength(usize);

impl KeyType for OutLength {
    fn len(&self) -> usize {
        self.0
    }
}

fn clear(secret: &mut [u8]) {
    secret.fill(0);
    // Keeps the compiler from dropping a store that nothing reads.
    std::hint::black_box(secret);
}

#[cfg(test)]
mod tests {
    use super::*;

    fn key() -> DomainKey {
        DomainKey::from_bytes(std::array::from_fn(|i| u8::try_from(i * 7).unwrap()))
    }

    #[test]
    fn text_reads_back_with_white_space() {
        let text = format!("  {}\n", key().to_text().to_uppercase());
        assert_eq!(DomainKey::parse(&text), Ok(key()));
    }

    #[test]
    fn errors_name_the_length_and_the_place() {
        assert_eq!(DomainKey::parse("abc"), Err(KeyError::Length { found: 3 }));
        let mut text = key().to_text();
        text.replace_range(9..10, "ö");
        assert_eq!(
            DomainKey::parse(&text),
            Err(KeyError::Digit { position: 10 })
        );
    }

    #[test]
    fn debug_hides_the_secret() {
        let shown = format!("{:?}", key());
        assert!(!shown.contains(&key().to_text()[..8]), "{shown}");
        assert!(shown.contains(&format!("{:04x}", key().id().0)));
    }

    #[test]
    fn key_id_is_golden_and_differs_between_keys() {
        assert_eq!(key().id(), KeyId(0xb664));
        assert_ne!(DomainKey::from_bytes([1; 32]).id(), key().id());
    }
}
