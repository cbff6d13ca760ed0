//! Benchmarks of ddx, each beside a floor (what no design can beat) and, on one host, beside iceoryx2, in the same run.
//!
//! The figures are medians over rounds in which all contenders take turns; a ratio is the median over the rounds of the ratios
//! of pairs. Nothing here fails because a machine is slow.

#![expect(
    clippy::print_stdout,
    clippy::print_stderr,
    reason = "its figures are what a benchmark is for"
)]

use std::process::ExitCode;

use anyhow::{Result, bail};
use clap::Parser;

use crate::bench::{Bench, LINES};
use crate::programs::Programs;
use crate::role::Role;
use crate::table::Table;

mod bench;
mod contender;
mod cost;
mod fallover;
mod floor;
mod frames;
mod local;
mod network;
mod pair;
mod programs;
mod role;
mod stats;
mod table;
mod video;

/// Measures ddx beside floors and peers.
#[derive(Parser)]
#[command(args_conflicts_with_subcommands = true)]
struct Args {
    #[command(flatten)]
    run: Run,
    #[command(subcommand)]
    program: Option<Program>,
}

#[derive(clap::Args)]
struct Run {
    /// Only show that each line gives figures, in less than a minute
    #[arg(long)]
    smoke: bool,
    /// Print one JSON document
    #[arg(long)]
    json: bool,
    /// Lines to measure: write wake poll large readers memory hosts spin idle cold fallover video raw replay [default: all]
    lines: Vec<String>,
}

#[derive(clap::Subcommand)]
enum Program {
    /// Play a part in a measurement; the bench starts itself so in other processes and hosts
    #[command(hide = true, subcommand)]
    Role(Role),
}

fn main() -> ExitCode {
    let args = Args::parse();
    let done = match args.program {
        Some(Program::Role(role)) => role.play(),
        None => run(&args.run),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}

fn run(args: &Run) -> Result<()> {
    if let Some(unknown) = args
        .lines
        .iter()
        .find(|name| LINES.iter().all(|(line, _)| line != name))
    {
        let known: Vec<_> = LINES.iter().map(|(line, _)| *line).collect();
        bail!("no line `{unknown}`\nhint: there are {}", known.join(", "));
    }
    let mut bench = Bench {
        smoke: args.smoke,
        programs: Programs::find(!args.smoke)?,
        table: Table::default(),
    };
    for (name, measure) in LINES {
        if args.lines.is_empty() || args.lines.iter().any(|line| line == name) {
            eprintln!("measuring: {name}");
            measure(&mut bench)?;
        }
    }
    if args.json {
        println!("{:#}", bench.table.to_json());
    } else {
        print!("{}", bench.table.to_text());
    }
    if !bench.table.is_complete() {
        bail!("a line gave no figure");
    }
    Ok(())
}
