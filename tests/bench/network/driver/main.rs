//! ddx between hosts, beside its peers: samples per second and per processor second, latency, bytes on the wire, under loss;
//! what idle items cost, how soon the first sample comes, how soon samples come again after a cut.
//!
//! `tests/bench/network/run` builds the peers and runs this. All contenders take their turns in the same namespaces and under
//! the same orders (`program.rs`); the figures are medians over rounds, each beside the best of its row. Nothing here fails
//! because a machine is slow.

#![expect(
    clippy::print_stdout,
    clippy::print_stderr,
    reason = "its figures are what a benchmark is for"
)]

use std::path::PathBuf;
use std::process::{Command, ExitCode};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use clap::Parser;

use crate::contender::{Build, CONTENDERS, Contender};
use crate::measure::Measure;
use crate::plan::Plan;
use crate::programs::ddx::Ddx;
use crate::programs::udp::Udp;
use crate::results::Results;

mod contender;
mod measure;
mod plan;
mod plot;
mod program;
mod programs;
mod results;
mod session;
mod table;

/// Measures ddx beside its peers, between hosts.
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
    /// Only show that ddx and the floor give figures, in less than a minute
    #[arg(long)]
    smoke: bool,
    /// Contenders by name [default: one for each way, of all that are built]
    #[arg(long, value_delimiter = ',')]
    only: Vec<String>,
    /// Also those that repeat every sample that is lost, and further links
    #[arg(long)]
    all: bool,
    /// Sizes of samples, bytes
    #[arg(long, value_delimiter = ',', default_values_t = plan::SIZES)]
    sizes: Vec<usize>,
    /// Rounds; the figures are their medians
    #[arg(long, default_value_t = 3)]
    rounds: usize,
    /// Begin no round that would end later than this
    #[arg(long, default_value_t = 24)]
    minutes: u64,
    /// Where the peers' programs are [default: target/network]
    #[arg(long)]
    programs: Option<PathBuf>,
    /// Where the table, the plot and all figures go [default: target/bench]
    #[arg(long)]
    out: Option<PathBuf>,
}

#[derive(clap::Subcommand)]
enum Program {
    /// Be the program of a contender; the bench starts itself so in the hosts of a lab
    #[command(hide = true)]
    Program {
        /// `ddx` or `udp`
        contender: String,
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        words: Vec<String>,
    },
}

/// Name of the host that publishes.
const PUBLISHER: &str = "a";

fn main() -> ExitCode {
    let args = Args::parse();
    let done = match args.program {
        Some(Program::Program { contender, words }) => match contender.as_str() {
            "ddx" => program::play(words, &Ddx),
            "udp" => program::play(words, &Udp),
            other => Err(anyhow::anyhow!("no program `{other}` in here")),
        },
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
    let began = Instant::now();
    let build = Build::find(args.programs.clone())?;
    let contenders = choose(args, &build)?;
    let plan = if args.smoke {
        Plan::smoke()
    } else {
        Plan::full(&args.sizes)
    };
    let out = args
        .out
        .clone()
        .unwrap_or_else(|| build.target.join("bench"));
    std::fs::create_dir_all(&out).with_context(|| format!("making `{}`", out.display()))?;

    let mut results = Results::default();
    let mut turns = |what: &str, turn: fn(&mut Measure<'_>) -> bool| {
        contenders.iter().all(|&contender| {
            eprintln!(
                "{:4} s  {what}: {}",
                began.elapsed().as_secs(),
                contender.name
            );
            turn(&mut Measure {
                contender,
                build: &build,
                plan: &plan,
                results: &mut results,
            })
        })
    };
    let limit = Duration::from_secs(60 * args.minutes);
    let mut last_round = Duration::ZERO;
    turns("once", |measure| {
        measure.once();
        true
    });
    let mut rounds = 0;
    for round in 1..=if args.smoke { 1 } else { args.rounds } {
        if began.elapsed() + last_round > limit {
            eprintln!("!!!! NO TIME for round {round}: the medians are over those before");
            break;
        }
        let round_began = Instant::now();
        if !turns(&format!("round {round}"), |measure| measure.round()) {
            return Ok(());
        }
        rounds += 1;
        last_round = round_began.elapsed();
    }
    results.rounds = rounds;

    let text = table::to_text(&results, &contenders, &plan, &conditions(&results));
    print!("{text}");
    for (name, content) in [
        ("network.md", text),
        ("network.svg", plot::to_svg(&results, &contenders, &plan)),
        ("network.json", format!("{:#}\n", results.to_json())),
    ] {
        let path = out.join(name);
        std::fs::write(&path, content).with_context(|| format!("writing `{}`", path.display()))?;
        eprintln!("wrote {}", path.display());
    }
    // A peer that fails is a row of dashes; this project's own program must give its figures.
    if !results.has_all(contender::DDX, &plan) {
        bail!("ddx gave no figure where it should");
    }
    Ok(())
}

/// The contenders that were asked for; those that are not built are named and left out.
fn choose(args: &Run, build: &Build) -> Result<Vec<&'static Contender>> {
    if let Some(unknown) = args
        .only
        .iter()
        .find(|name| CONTENDERS.iter().all(|known| known.name != **name))
    {
        let known: Vec<_> = CONTENDERS.iter().map(|known| known.name).collect();
        bail!(
            "no contender `{unknown}`\nhint: there are {}",
            known.join(", ")
        );
    }
    let is_wanted = |contender: &Contender| {
        if !args.only.is_empty() {
            args.only.iter().any(|name| name == contender.name)
        } else if args.smoke {
            contender.is_own()
        } else {
            args.all || !contender.is_extra
        }
    };
    let mut chosen = Vec::new();
    for contender in CONTENDERS.iter().filter(|contender| is_wanted(contender)) {
        match build.missing(contender) {
            None => chosen.push(contender),
            Some(path) => eprintln!(
                "!!!! LEFT OUT: {} is not built: `{}` is missing",
                contender.name,
                path.display()
            ),
        }
    }
    Ok(chosen)
}

/// What the figures depend on, for people.
fn conditions(results: &Results) -> String {
    let read = |path: &str| {
        std::fs::read_to_string(path).map_or_else(|_| "?".to_owned(), |text| text.trim().to_owned())
    };
    let cores = std::thread::available_parallelism().map_or(0, usize::from);
    let kernel = Command::new("uname").arg("-r").output();
    let kernel = kernel.map_or_else(
        |_| "?".to_owned(),
        |output| String::from_utf8_lossy(&output.stdout).trim().to_owned(),
    );
    format!(
        "{cores} cores, kernel {kernel}, load {}, rounds {}. Every program asks for socket buffers of {} bytes where its \
         library lets it; the kernel grants at most {} (net.core.rmem_max).\n",
        read("/proc/loadavg"),
        results.rounds,
        program::SOCKET_BUFFER_BYTES,
        read("/proc/sys/net/core/rmem_max"),
    )
}
