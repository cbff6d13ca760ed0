//! Coming back to a daemon that was started anew: each handle's registration is said again, in its old words.
//!
//! Living writers hand over the segment that they have, under its old epoch. Readers name the cell that they hold, so
//! that nobody else is given it. What was mapped stays readable throughout.

use std::os::fd::AsFd;
use std::sync::Arc;
use std::time::Instant;

use ddx_wire::Contract;

use crate::connection::{Mail, Mailbox, State, TIMEOUT, segment_fds};
use crate::control::{Binding, HeldCell, Refusal, Reply, Request};
use crate::error::Error;
use crate::segment::SegmentFds;

/// What a daemon must be told about one handle.
#[derive(Debug)]
pub(crate) enum Registration {
    /// A writer that has handed its segment over.
    Writer {
        name: String,
        schema: String,
        fds: SegmentFds,
        mailbox: Arc<Mailbox>,
    },
    /// An open reader.
    Reader {
        name: String,
        schema: Option<String>,
        pins: u32,
        contract: Contract,
        held: Option<HeldCell>,
        mailbox: Arc<Mailbox>,
    },
}

impl Registration {
    pub(crate) fn mailbox(&self) -> &Mailbox {
        match self {
            Self::Writer { mailbox, .. } | Self::Reader { mailbox, .. } => mailbox,
        }
    }

    /// Remembers the place that a reader was given.
    pub(crate) fn note_binding(&mut self, binding: &Binding) {
        if let Self::Reader { held, .. } = self {
            *held = Some(binding.held());
        }
    }

    fn request(&self, handle: u32) -> Request {
        match self {
            Self::Writer { name, schema, .. } => Request::Resume {
                handle,
                name: name.clone(),
                schema: schema.clone(),
            },
            Self::Reader {
                name,
                schema,
                pins,
                contract,
                held,
                ..
            } => Request::OpenReader {
                handle,
                name: name.clone(),
                schema: schema.clone(),
                pins: *pins,
                contract: *contract,
                held: *held,
            },
        }
    }
}

impl State {
    /// Tells a new daemon of all handles, writers first so that their readers find them. What it refuses becomes news
    /// for the handle; when it dies again, the next attempt starts over.
    pub(crate) fn register_anew(&mut self) {
        let mut handles: Vec<_> = self.registrations.keys().copied().collect();
        handles.sort_by_key(|handle| {
            let registration = self.registrations.get(handle);
            !matches!(registration, Some(Registration::Writer { .. }))
        });
        for handle in handles {
            let Some(mut registration) = self.registrations.remove(&handle) else {
                continue;
            };
            let answer = self.register_one(handle, &mut registration);
            self.registrations.insert(handle, registration);
            if answer.is_err() {
                self.socket = None;
                return;
            }
        }
    }

    fn register_one(&mut self, handle: u32, registration: &mut Registration) -> Result<(), Error> {
        let deadline = Instant::now() + TIMEOUT;
        let request = registration.request(handle);
        let answer = match &*registration {
            Registration::Writer { fds, .. } => {
                self.ask(request, &[fds.data.as_fd(), fds.ctl.as_fd()], deadline)
            }
            Registration::Reader { .. } => self.ask(request, &[], deadline),
        };
        let mail = match answer {
            Ok((
                Reply::Reader {
                    binding: Some(binding),
                    ..
                },
                fds,
            )) => {
                registration.note_binding(&binding);
                segment_fds(fds).map(|fds| Mail::Bound(binding, fds))
            }
            Ok((Reply::Reader { binding: None, .. }, _)) => Some(Mail::Detached),
            Ok(_) => None,
            Err(Error::Refused(refusal @ Refusal::Message(_))) => {
                return Err(Error::Refused(refusal));
            }
            Err(Error::Refused(refusal)) => Some(Mail::Refused(refusal)),
            Err(other) => return Err(other),
        };
        if let Some(mail) = mail {
            registration.mailbox().put(mail);
        }
        Ok(())
    }
}
