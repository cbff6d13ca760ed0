//! The command line: what can be typed, as data, and the one place that exits. One file for each verb.

mod books;
mod demo;
mod doctor;
mod get;
mod host;
mod hz;
mod info;
mod interrupt;
mod key;
mod ls;
mod output;
mod put;
mod render;
mod rm;
mod source;
mod stat;
mod state;
mod subscription;
mod topic;
mod up;
mod video;
mod watch;
mod why;

use std::path::PathBuf;
use std::process::ExitCode;

use clap::{Parser, Subcommand};
use ddx_store::Store;
use ddx_wire::Pattern;
use tracing_subscriber::EnvFilter;

use self::output::{Closed, Output};
use crate::error::{Exit, Failure, Hint as _, Outcome};

#[derive(Debug, Parser)]
#[command(
    name = "ddx",
    version,
    about = "One name space for a fleet: named items, sent only when somebody reads",
    disable_help_subcommand = true,
    disable_help_flag = true,
    disable_version_flag = true,
    max_term_width = 80,
    help_template = "{about}\n{usage-heading} {usage}\n{subcommands}\n{options}{after-help}",
    after_help = "\
Examples: ddx up                          serve this host
          ddx put speed 1.5 --type f64    write an item
          ddx watch 'robot1/**'           see every item of a robot, live"
)]
struct Cli {
    /// Print one JSON object per line
    #[arg(long, global = true)]
    json: bool,
    /// Socket of the daemon [default: DDX_SOCKET, or the one]
    #[arg(long, global = true, value_name = "PATH")]
    socket: Option<PathBuf>,
    /// End when standard input closes, as a child of `ddx demo` must
    #[arg(long, global = true, hide = true)]
    tethered: bool,
    /// Print this
    #[arg(short = 'h', long, action = clap::ArgAction::Help, global = true, hide = true)]
    help: Option<bool>,
    /// Print the version
    #[arg(short = 'V', long, action = clap::ArgAction::Version, hide = true)]
    version: Option<bool>,
    #[command(subcommand)]
    verb: Verb,
}

#[derive(Debug, Subcommand)]
enum Verb {
    /// Serve this host, in the foreground
    Up(up::Args),
    /// List items, here and on other hosts
    Ls(ls::Args),
    /// Print the present value of an item
    Get(get::Args),
    /// Write a value; --type makes a new item
    Put(put::Args),
    /// Remove an item that nobody writes
    Rm(rm::Args),
    /// Show values as they change, with age and losses
    Watch(watch::Args),
    /// Measure how often an item is written
    Hz(hz::Args),
    /// Show all that is known of an item
    Info(info::Args),
    /// Show what became of each sample, hop by hop
    Stat(stat::Args),
    /// Say in one sentence why a reader gets nothing
    Why(why::Args),
    /// Check this host, and say what to do (multicast)
    Doctor(doctor::Args),
    /// List the hosts of the domain (ls)
    #[command(subcommand)]
    Host(host::Verb),
    /// Make a domain key (new)
    #[command(subcommand)]
    Key(key::Verb),
    /// Publish real data (nmea, system)
    #[command(subcommand)]
    Source(source::Verb),
    /// Streams of video (load, save, view, serve, ...)
    #[command(subcommand)]
    Video(video::Verb),
    /// Show two hosts, a link and its failures
    Demo(demo::Args),
    /// Names that those who come from ROS 2 know.
    #[command(subcommand, hide = true)]
    Topic(topic::Verb),
}

/// What each verb gets beside its own arguments.
#[derive(Debug)]
struct Context {
    socket: Option<PathBuf>,
    tethered: bool,
    out: Output,
}

/// Runs the program with the arguments of the process and returns its exit code: 0 done, 1 failed, 2 bad arguments, 3 done
/// with loss.
pub fn main() -> ExitCode {
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(refusal) => {
            let exit = if refusal.use_stderr() {
                Exit::BadArguments
            } else {
                Exit::Done
            };
            // Nobody is left to tell when the stream is closed.
            let _closed = refusal.print();
            return exit.into();
        }
    };
    let default = if matches!(cli.verb, Verb::Up(_)) {
        "info"
    } else {
        "warn"
    };
    tracing_subscriber::fmt()
        .with_writer(std::io::stderr)
        .with_env_filter(
            EnvFilter::try_from_default_env().unwrap_or_else(|_unset| EnvFilter::new(default)),
        )
        .init();
    match run(cli) {
        Ok(exit) => exit.into(),
        // Whoever read our output has seen enough.
        Err(failure) if failure.error().is::<Closed>() => Exit::Done.into(),
        Err(failure) => {
            output::note(&failure.to_string());
            failure.exit().into()
        }
    }
}

fn run(cli: Cli) -> Outcome {
    let mut context = Context {
        socket: cli.socket,
        tethered: cli.tethered,
        out: Output::new(cli.json),
    };
    let context = &mut context;
    match cli.verb {
        Verb::Up(args) => up::run(context, args),
        Verb::Ls(args) => ls::run(context, &args),
        Verb::Get(args) => get::run(context, &args),
        Verb::Put(args) => put::run(context, &args),
        Verb::Rm(args) => rm::run(context, &args),
        Verb::Watch(args) => watch::run(context, &args),
        Verb::Hz(args) => hz::run(context, &args),
        Verb::Info(args) => info::run(context, &args),
        Verb::Stat(args) => stat::run(context, &args),
        Verb::Why(args) => why::run(context, &args),
        Verb::Doctor(args) => doctor::run(context, &args),
        Verb::Host(verb) => host::run(context, &verb),
        Verb::Key(verb) => key::run(context, &verb),
        Verb::Source(verb) => source::run(context, &verb),
        Verb::Video(verb) => video::run(context, &verb),
        Verb::Demo(args) => demo::run(context, &args),
        Verb::Topic(verb) => topic::run(context, &verb),
    }
}

impl Context {
    /// Connects to the daemon of this host as the program `ddx <verb>`.
    fn store(&self, verb: &str) -> Result<Store, Failure> {
        let options = Store::options().program(&format!("ddx {verb}"));
        let options = match &self.socket {
            Some(path) => options.socket(path),
            None => options,
        };
        Ok(options.open()?)
    }
}

/// Reads a pattern as it is meant on the host of `store`.
fn pattern(store: &Store, text: Option<&str>) -> Result<Pattern, Failure> {
    match text {
        None => Ok(Pattern::everything()),
        Some(text) => Pattern::parse(text, store.host())
            .hint(|| {
                "a pattern is a name in which `*` stands for one chunk and `**` for any number"
                    .to_owned()
            })
            .arguments(),
    }
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory as _;

    use super::*;

    #[test]
    fn the_arguments_contradict_nothing() {
        Cli::command().debug_assert();
    }

    #[test]
    fn help_fits_one_screen_and_shows_three_examples() {
        let help = Cli::command().render_help().to_string();

        assert!(help.lines().count() <= 24, "{help}");
        assert!(
            help.lines().all(|line| line.chars().count() <= 80),
            "{help}"
        );
        let (_, examples) = help.split_once("Examples:").unwrap();
        assert_eq!(examples.matches("ddx ").count(), 3, "{help}");
    }
}
