//! The twin of a mapping: memory of this process alone, for tests and for miri.

use std::alloc::{Layout, alloc_zeroed, dealloc};
use std::ptr::NonNull;

use super::{Backing, Map, ShmError};
use crate::layout::LINE;

/// Allocates `len` zeroed bytes, a positive multiple of [`LINE`].
pub fn create(len: usize) -> Result<Map, ShmError> {
    let size = ShmError::Size {
        what: "heap",
        found: len,
    };
    if len == 0 || !len.is_multiple_of(LINE) {
        return Err(size);
    }
    let Ok(layout) = Layout::from_size_align(len, LINE) else {
        return Err(size);
    };
    // SAFETY: the layout has a size other than zero.
    let base = unsafe { alloc_zeroed(layout) };
    let base = NonNull::new(base).ok_or(size)?;
    Ok(Map {
        base,
        len,
        backing: Backing::Heap,
    })
}

pub(super) fn free(base: NonNull<u8>, len: usize) {
    let layout =
        Layout::from_size_align(len, LINE).expect("the layout was valid when it was allocated");
    // SAFETY: `create` allocated `base` with this layout, and the map that owned it is being dropped.
    unsafe { dealloc(base.as_ptr(), layout) };
}
