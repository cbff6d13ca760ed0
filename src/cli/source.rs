//! `ddx source`: publishes real data until it ends or is interrupted.

use std::path::PathBuf;
use std::time::Duration;

use serde_json::json;

use super::Context;
use super::interrupt::Interrupt;
use crate::error::{Exit, Outcome};
use crate::source::{nmea, system};
use crate::units;

/// Which source.
#[derive(Debug, clap::Subcommand)]
pub(crate) enum Verb {
    /// The log of a GPS receiver (NMEA 0183), at its own pace
    Nmea(Nmea),
    /// This machine's load, memory and network counters
    System(System),
}

/// Which log, and how to play it.
#[derive(Debug, clap::Args)]
pub(crate) struct Nmea {
    /// The log
    file: PathBuf,
    /// Items are NAME/fix, NAME/satellites, NAME/speed, NAME/course
    #[arg(long, default_value = "gps")]
    name: String,
    /// Times as fast as recorded
    #[arg(long, value_name = "FACTOR", default_value = "1", value_parser = factor)]
    rate: f64,
    /// Start again at the end
    #[arg(long = "loop")]
    looped: bool,
}

/// How often.
#[derive(Debug, clap::Args)]
pub(crate) struct System {
    /// Items are NAME/load, NAME/memory, NAME/network
    #[arg(long, default_value = "sys")]
    name: String,
    /// Samples a second
    #[arg(long, value_name = "RATE", default_value = "1 Hz", value_parser = units::rate)]
    rate: f64,
}

/// Runs the verb.
pub(crate) fn run(context: &mut Context, verb: &Verb) -> Outcome {
    match verb {
        Verb::Nmea(args) => play(context, args),
        Verb::System(args) => measure(context, args),
    }
}

fn play(context: &mut Context, args: &Nmea) -> Outcome {
    let log = nmea::Log::read(&args.file)?;
    let interrupt = Interrupt::listen(context.tethered)?;
    let mut player = nmea::Player::open(&context.store("source nmea")?, &args.name)?;
    let mut passes = 0_u64;
    let mut next = Some(ddx_store::now());
    while let Some(start) = next {
        next = player.play(&log, start, args.rate, |due| interrupt.sleep_until(due))?;
        passes += u64::from(next.is_some());
        next = next.filter(|_| args.looped);
    }
    context.out.either(
        &json!({ "passes": passes, "samples": log.len(), "bad_lines": log.bad_lines }),
        &format!(
            "{passes} passes of {} samples; {} bad lines",
            log.len(),
            log.bad_lines
        ),
    )?;
    Ok(if log.bad_lines > 0 {
        Exit::DoneWithLoss
    } else {
        Exit::Done
    })
}

fn measure(context: &Context, args: &System) -> Outcome {
    let interrupt = Interrupt::listen(context.tethered)?;
    let mut gauge = system::Gauge::open(&context.store("source system")?, &args.name)?;
    let interval = Duration::from_secs_f64(args.rate.recip());
    let mut due = ddx_store::now();
    while interrupt.sleep_until(due) {
        gauge.publish()?;
        // A machine that was asleep does not catch up.
        due = (due + interval).max(ddx_store::now());
    }
    Ok(Exit::Done)
}

fn factor(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(factor) if (0.001..=1e4).contains(&factor) => Ok(factor),
        Ok(_) | Err(_) => Err(format!("`{text}` is not a factor between 0.001 and 10000")),
    }
}
