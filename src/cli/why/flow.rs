//! What a second of looking on tells: whether samples flow as fast as they are written, and which step holds them back.

use ddx_store::{Description, ReaderEntry};
use ddx_wire::ItemName;
use serde_json::{Value, json};

use super::super::books::{DAEMON, Rates, Row};
use super::super::ls::{elapsed_ns, writer};
use super::super::render::{bytes, rate, span};
use super::super::state::Way;
use super::{Reason, Verdict};

/// What was seen of an item that is there and written.
pub(super) struct Flow<'a> {
    pub(super) name: &'a ItemName,
    pub(super) item: &'a Description,
    /// Whether it is of this host.
    pub(super) own: bool,
    pub(super) ways: &'a [Way],
    /// Its books, and how fast they moved.
    pub(super) rows: Vec<(&'a Row, Rates)>,
    pub(super) now_ns: u64,
}

/// What was found at one step of the way.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Step {
    /// `writer`, `store`, `contract`, `path`, `link` or `reader`.
    pub(super) step: &'static str,
    /// Whether nothing is wrong there.
    pub(super) fine: bool,
    pub(super) text: String,
}

/// A step that holds samples back.
struct Fault {
    reason: Reason,
    step: &'static str,
    sentence: String,
    hint: Option<String>,
}

impl Step {
    pub(super) fn object(&self) -> Value {
        json!({ "step": self.step, "fine": self.fine, "text": self.text })
    }

    pub(super) fn line(&self) -> String {
        let mark = if self.fine { "ok" } else { "!!" };
        format!("{mark}  {:<9} {}", self.step, self.text)
    }
}

impl Flow<'_> {
    /// The first step that holds samples back, or `fine`, with what was found at each.
    pub(super) fn judge(&self, fine: Verdict) -> Verdict {
        let faults = [
            self.contract(),
            self.path(),
            self.slow_link(),
            self.loss(),
            self.slow_reader(),
        ];
        let faults: Vec<Fault> = faults.into_iter().flatten().collect();
        let mut steps = self.steps();
        for fault in &faults {
            steps.push(Step {
                step: fault.step,
                fine: false,
                text: fault.sentence.clone(),
            });
        }
        steps.sort_by_key(|step| STEPS.iter().position(|known| *known == step.step));
        // Multicast that does not work costs the network, and no reader anything.
        let worst = faults
            .iter()
            .position(|fault| fault.reason != Reason::NoMulticast);
        let verdict = match faults.into_iter().nth(worst.unwrap_or(0)) {
            None if !self.own && self.rows.iter().all(|(_, rates)| rates.expected < 0.01) => {
                let (name, host) = (self.name, self.name.prefix());
                fine.hint(format!(
                    "nothing came while this looked on; `ddx why {name}` on `{host}` shows the sending side"
                ))
            }
            None => fine,
            Some(fault) => Verdict {
                hint: fault.hint,
                ..Verdict::new(fault.reason, fault.sentence)
            },
        };
        Verdict { steps, ..verdict }
    }

    fn rows(&self, hop: &'static str) -> impl Iterator<Item = (&Row, &Rates)> {
        let rows = self.rows.iter().filter(move |(row, _)| row.hop == hop);
        rows.map(|(row, rates)| (*row, rates))
    }

    /// The contract keeps back all that is written.
    fn contract(&self) -> Option<Fault> {
        let written = self.rows("writer to store").map(|(_, r)| r.expected).next();
        let written = written.unwrap_or(0.0);
        for (row, rates) in self.rows("store to stream") {
            let contract = row.contract.as_deref().unwrap_or_default();
            let whose = format!("the contract of {} ({contract})", self.peers());
            if rates.delivered > 0.01 {
                continue;
            }
            let sentence = if rates.expected > 0.01 && row.fates.expired > 0 {
                format!(
                    "{whose} keeps back all of `{}`: {} samples a second were older than that when their turn came",
                    self.name,
                    count(rates.expected)
                )
            } else if row.interval_ns >= SELDOM_NS && written > 0.01 {
                format!(
                    "{whose} lets a sample of `{}` through each {}, of {} that are written a second",
                    self.name,
                    span(row.interval_ns),
                    count(written)
                )
            } else {
                continue;
            };
            return Some(Fault::new(Reason::Contract, "contract", sentence));
        }
        // Of another host's item, what does not come says nothing; how seldom it is to come is known here.
        let (row, rates) = self.rows("link to mirror").next()?;
        let asked = self.item.readers.iter();
        let interval = asked.map(|reader| reader.contract.interval_ns()).min()?;
        let last = elapsed_ns(self.item.entry.last_publish?, ddx_wire::Time(self.now_ns));
        if rates.expected > 0.01 || interval < SELDOM_NS || last > interval {
            return None;
        }
        let sentence = format!(
            "the contract of {} ({}) lets a sample of `{}` through each {}: the last one came {} ago",
            self.readers(),
            row.contract.as_deref().unwrap_or_default(),
            self.name,
            span(interval),
            span(last)
        );
        Some(Fault::new(Reason::Contract, "contract", sentence))
    }

    /// A reading host is not served by multicast, because that does not work.
    fn path(&self) -> Option<Fault> {
        let shunning = self
            .ways
            .iter()
            .filter(|way| way.is_out && way.shuns.is_some());
        let texts: Vec<String> = shunning.map(|way| way.text(self.now_ns)).collect();
        if texts.is_empty() {
            return None;
        }
        let sentence = format!("`{}` goes {}", self.name, texts.join("; "));
        let fault = Fault::new(Reason::NoMulticast, "path", sentence);
        Some(fault.hint("`ddx doctor multicast` shows between which hosts multicast passes"))
    }

    /// A link carries less than what is wanted.
    fn slow_link(&self) -> Option<Fault> {
        let wanted = self.rows("store to stream").map(|(_, rates)| rates.bytes);
        let wanted = wanted.fold(0.0, f64::max);
        for (row, rates) in self.rows("store to link") {
            let left_out = rates.queue_dropped + rates.overwritten;
            let stuck = row.waiting && rates.delivered < 0.01;
            if left_out < SHARE * rates.expected.max(1.0) && !stuck {
                continue;
            }
            let carries = row.link.map_or(0, |link| link.bytes_per_second);
            let contract = row.contract.as_deref().unwrap_or_default();
            let sentence = format!(
                "the link to {} carries {}/s, and `{}` wants {}/s ({}): {} of {} samples a second are left out",
                quoted(&row.peers),
                bytes(carries),
                self.name,
                bytes(whole(wanted)),
                with_priority(contract),
                count(left_out),
                count(rates.expected)
            );
            let fault = Fault::new(Reason::SlowLink, "link", sentence);
            return Some(fault.hint(
                "read it with a lower rate, or with a higher priority at the cost of other items",
            ));
        }
        let (row, rates) = self.rows("link to mirror").next()?;
        // What a rate keeps back is as it was asked.
        let asked = self
            .item
            .readers
            .iter()
            .any(|r| r.contract.interval_ns() == 0);
        let left_out = rates.filtered + rates.overwritten;
        if !asked || left_out < SHARE * rates.expected.max(1.0) {
            return None;
        }
        let each = rates.bytes / rates.delivered.max(0.001);
        let sentence = format!(
            "the link from {} brings {}/s of `{}`, of which {}/s are written ({}): {} of {} samples a second are left out there",
            quoted(&row.peers),
            bytes(whole(rates.bytes)),
            self.name,
            bytes(whole(each * rates.expected)),
            with_priority(row.contract.as_deref().unwrap_or_default()),
            count(left_out),
            count(rates.expected)
        );
        let fault = Fault::new(Reason::SlowLink, "link", sentence);
        Some(fault.hint(format!(
            "`ddx why {}` on {} shows the rate of the link",
            self.name,
            quoted(&row.peers)
        )))
    }

    /// Too much is lost on the way.
    fn loss(&self) -> Option<Fault> {
        for (row, rates) in self.rows("link to mirror") {
            let sent = rates.delivered + rates.lost;
            if rates.lost < LOST * sent || rates.lost <= 0.0 {
                continue;
            }
            let sentence = format!(
                "{:.1} % of `{}` is lost on the way from {}: {} of {} samples a second",
                100.0 * rates.lost / sent,
                self.name,
                quoted(&row.peers),
                count(rates.lost),
                count(sent)
            );
            let fault = Fault::new(Reason::Loss, "link", sentence);
            return Some(fault.hint("`--every` has what is lost sent again"));
        }
        for (row, rates) in self.rows("store to link") {
            let lost = row.link.map_or(0.0, |link| link.loss_percent);
            if lost < 100.0 * LOST || rates.delivered < 0.01 {
                continue;
            }
            let sentence = format!(
                "{lost:.1} % of datagrams are lost on the way to {}, by {}; what `{}` lacks is sent again as its contract asks",
                quoted(&row.peers),
                row.via.as_deref().unwrap_or("?"),
                self.name
            );
            return Some(Fault::new(Reason::Loss, "link", sentence));
        }
        None
    }

    /// A program on this host takes less than what comes.
    fn slow_reader(&self) -> Option<Fault> {
        let hop = if self.own {
            "store to reader"
        } else {
            "mirror to reader"
        };
        let comes = match self.own {
            true => self.rows("writer to store").map(|(_, r)| r.expected).next(),
            false => self.rows("link to mirror").map(|(_, r)| r.delivered).next(),
        };
        // What its host's ring let go before it was sent is no fault of a reader here.
        let there = self
            .rows("link to mirror")
            .map(|(_, r)| r.overwritten)
            .next();
        for (row, rates) in self.rows(hop) {
            // What the daemon leaves out is told by the link.
            if row.peers.iter().any(|peer| peer == DAEMON) {
                continue;
            }
            let comes = comes.unwrap_or(0.0);
            let overwritten = rates.overwritten - there.unwrap_or(0.0);
            let stands = rates.expected < 0.01 && comes * LOOKED_S > f64::from(self.item.depth);
            if !stands && overwritten < SHARE * rates.expected.max(1.0) {
                continue;
            }
            let (who, depth) = (row.peers.join(", "), self.item.depth);
            let sentence = if stands {
                format!(
                    "{who} has stopped reading `{}`: {} samples a second come, and the ring holds {depth}",
                    self.name,
                    count(comes)
                )
            } else {
                format!(
                    "{who} reads `{}` too slowly: {} of {} samples a second were overwritten in the ring of {depth} before it read them",
                    self.name,
                    count(overwritten),
                    count(rates.expected)
                )
            };
            return Some(Fault::new(Reason::SlowReader, "reader", sentence));
        }
        None
    }

    /// What is known of each step, right or wrong.
    fn steps(&self) -> Vec<Step> {
        let mut steps = Vec::new();
        let mut add = |step: &'static str, text: String| {
            steps.push(Step {
                step,
                fine: true,
                text,
            });
        };
        let entry = &self.item.entry;
        let ago = entry.last_publish.map_or_else(
            || "?".to_owned(),
            |at| span(elapsed_ns(at, ddx_wire::Time(self.now_ns))),
        );
        add(
            "writer",
            format!(
                "{} on `{}`, the last value {ago} ago",
                writer(entry),
                entry.host
            ),
        );
        add(
            "store",
            format!(
                "{} samples in epoch {}, a ring of {}",
                self.item.published, self.item.epoch.0, self.item.depth
            ),
        );
        for (row, rates) in self.rows("store to stream") {
            let contract = row.contract.as_deref().unwrap_or_default();
            add(
                "contract",
                format!(
                    "{contract}: {} of {} pass",
                    rate(Some(rates.delivered)),
                    rate(Some(rates.expected))
                ),
            );
        }
        for reader in &self.item.readers {
            if !self.own {
                add("contract", format!("{}: {}", who(reader), reader.contract));
            }
        }
        for way in self.ways {
            add("path", way.text(self.now_ns));
        }
        for (row, rates) in self.rows("store to link") {
            let link = row.link.unwrap_or_default();
            add(
                "link",
                format!(
                    "to {} by {}: {} in {}/s; it carries {}/s, queues for {}, loses {:.1} %",
                    quoted(&row.peers),
                    row.via.as_deref().unwrap_or("?"),
                    rate(Some(rates.delivered)),
                    bytes(whole(rates.bytes)),
                    bytes(link.bytes_per_second),
                    span(link.queue_us.saturating_mul(1_000)),
                    link.loss_percent
                ),
            );
        }
        for (row, rates) in self.rows("link to mirror") {
            add(
                "link",
                format!(
                    "from {}: {} in {}/s; {} left out there, {} lost, of {} so far",
                    quoted(&row.peers),
                    rate(Some(rates.delivered)),
                    bytes(whole(rates.bytes)),
                    row.fates.filtered + row.fates.overwritten,
                    row.fates.lost + row.fates.late,
                    row.expected
                ),
            );
        }
        let hop = if self.own {
            "store to reader"
        } else {
            "mirror to reader"
        };
        for (row, rates) in self.rows(hop) {
            add(
                "reader",
                format!(
                    "{}: {}; {} overwritten of {} so far",
                    row.peers.join(", "),
                    rate(Some(rates.delivered)),
                    row.fates.overwritten,
                    row.expected
                ),
            );
        }
        steps
    }

    /// The hosts that read it.
    fn peers(&self) -> String {
        let out = self.ways.iter().filter(|way| way.is_out);
        let peers: Vec<String> = out.filter_map(|way| way.peer.clone()).collect();
        quoted(&peers)
    }

    fn readers(&self) -> String {
        let readers: Vec<String> = self.item.readers.iter().map(who).collect();
        readers.join(", ")
    }
}

impl Fault {
    fn new(reason: Reason, step: &'static str, sentence: String) -> Self {
        Self {
            reason,
            step,
            sentence,
            hint: None,
        }
    }

    fn hint(self, hint: impl Into<String>) -> Self {
        Self {
            hint: Some(hint.into()),
            ..self
        }
    }
}

fn who(reader: &ReaderEntry) -> String {
    format!("`{}` (pid {})", reader.program, reader.pid)
}

/// A contract in words, also if its priority is the usual one.
fn with_priority(contract: &str) -> String {
    let told = ["background", "priority", "command"];
    match told.iter().any(|word| contract.contains(word)) {
        true => contract.to_owned(),
        false => format!("{contract}, normal priority"),
    }
}

fn quoted(names: &[String]) -> String {
    let names: Vec<String> = names.iter().map(|name| format!("`{name}`")).collect();
    names.join(", ")
}

/// A rate as a count of samples.
fn count(rate: f64) -> String {
    if rate < 9.95 && rate.fract() > 0.05 {
        format!("{rate:.1}")
    } else {
        format!("{rate:.0}")
    }
}

fn whole(rate: f64) -> u64 {
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a rate is not negative, and a conversion saturates"
    )]
    let whole = rate as u64;
    whole
}

const STEPS: [&str; 6] = ["writer", "store", "contract", "path", "link", "reader"];
/// Share of samples left out or overwritten that is worth a sentence.
const SHARE: f64 = 0.05;
/// Share lost that is.
const LOST: f64 = 0.02;
/// An item of which a sample comes less often than this looks as if none came.
const SELDOM_NS: u64 = 2_000_000_000;
/// For how long it is looked on, at least.
const LOOKED_S: f64 = 1.0;
