//! `ddx demo`: two hosts, the link between them, and its failures, on screen.
//!
//! The acts: nobody reads, and nothing crosses; base reads; base looks at robot1's video too; the link is cut and healed;
//! robot1 is killed and started again. Both must recover, or the exit code is 1.

mod show;
mod stage;

use std::thread;
use std::time::Duration;

use serde_json::json;

use self::show::Show;
use self::stage::{Ground, Stage};
use super::Context;
use super::interrupt::Interrupt;
use crate::error::{Exit, Failure, Outcome};

/// For how long.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Length of the show; below 12 the failures are left out; 0 starts the hosts and stays, for you to look round
    /// [default: 20, or 0 with `--serve`]
    #[arg(long, value_name = "N")]
    seconds: Option<u32>,
    /// Show robot1's video, as base sees it, in a browser
    #[arg(long)]
    serve: bool,
}

/// Runs the verb.
pub(crate) fn run(context: &mut Context, args: &Args) -> Outcome {
    if !args.serve {
        // The browser is not in there.
        stage::enter_user_namespace();
    }
    let seconds = args.seconds.unwrap_or(if args.serve { 0 } else { 20 });
    let interrupt = Interrupt::listen(context.tethered)?;
    let mut stage = Stage::build()?;
    let (ground, text) = match &stage.ground {
        Ground::Namespaces => (
            "namespaces",
            "robot1 and base run in network namespaces of their own, with a cable between them"
                .to_owned(),
        ),
        Ground::Loopback { reason } => (
            "loopback",
            format!(
                "robot1 and base share the loopback, as namespaces cannot be had ({reason}); a cut is a stopped daemon here"
            ),
        ),
    };
    context.out.either(
        &json!({ "event": "ground", "ground": ground, "text": text }),
        &text,
    )?;
    if args.serve {
        let url = stage.start_server()?;
        context.out.either(
            &json!({ "event": "served", "url": url }),
            &format!("robot1's video, as base sees it: {url}"),
        )?;
    }
    if seconds == 0 {
        return stay(context, &stage, &interrupt);
    }
    let acts = if seconds < WHOLE_S {
        &ACTS[..UNBROKEN]
    } else {
        &ACTS[..]
    };
    let scale = f64::from(seconds) / acts.iter().map(|act| act.seconds).sum::<f64>();
    let mut show = Show::new(&mut context.out, &stage, interrupt.clone())?;
    for act in acts {
        show.enter(act.key, act.text)?;
        match act.deed {
            Deed::Look => {}
            Deed::Read => show.subscribe(|name| name != VIDEO)?,
            Deed::See => show.subscribe(|name| name == VIDEO)?,
            Deed::Cut => stage.cut()?,
            Deed::Heal => stage.heal()?,
            Deed::Kill => {
                show.robot_dies();
                stage.kill_robot();
            }
            Deed::Start => {
                stage.start_robot()?;
                show.robot_lives(&stage)?;
            }
        }
        show.play(&stage, Duration::from_secs_f64(act.seconds * scale))?;
        if interrupt.is_raised() {
            return Ok(Exit::Failed);
        }
    }
    if acts.len() < ACTS.len() {
        super::output::note(&format!(
            "hint: --seconds {WHOLE_S} or more shows a cut link and a killed robot too"
        ));
    }
    if show.finish()? {
        Ok(Exit::Done)
    } else {
        Err(Failure::new("not every item came back").with_hint("RUST_LOG=debug shows more"))
    }
}

fn stay(context: &mut Context, stage: &Stage, interrupt: &Interrupt) -> Outcome {
    let command = format!(
        "DDX_SOCKET={} ddx watch 'robot1/**'",
        stage.base.socket().display()
    );
    context.out.either(
        &json!({ "event": "stay", "command": command }),
        &format!("In another terminal:\n\n  {command}\n\nCtrl-C ends it."),
    )?;
    while !interrupt.is_raised() {
        thread::sleep(Duration::from_millis(50));
    }
    Ok(Exit::Done)
}

/// One act of the show.
struct Act {
    key: &'static str,
    text: &'static str,
    deed: Deed,
    /// Of a show of 20 s.
    seconds: f64,
}

#[derive(Clone, Copy)]
enum Deed {
    Look,
    Read,
    See,
    Cut,
    Heal,
    Kill,
    Start,
}

const ACTS: [Act; 7] = [
    Act {
        key: "unread",
        text: "robot1 publishes, nobody reads: no sample crosses the link",
        deed: Deed::Look,
        seconds: 3.0,
    },
    Act {
        key: "read",
        text: "base reads robot1/**, all but the video",
        deed: Deed::Read,
        seconds: 3.0,
    },
    Act {
        key: "seen",
        text: "base looks at robot1/cam (Big Buck Bunny, (c) 2008 Blender Foundation, CC BY 3.0)",
        deed: Deed::See,
        seconds: 3.0,
    },
    Act {
        key: "cut",
        text: "the link is cut",
        deed: Deed::Cut,
        seconds: 3.0,
    },
    Act {
        key: "healed",
        text: "the link is healed",
        deed: Deed::Heal,
        seconds: 3.0,
    },
    Act {
        key: "killed",
        text: "robot1 is killed (kill -9, its daemon and its programs)",
        deed: Deed::Kill,
        seconds: 2.0,
    },
    Act {
        key: "restarted",
        text: "robot1 starts again",
        deed: Deed::Start,
        seconds: 4.0,
    },
];
/// The frames of robot1.
const VIDEO: &str = "robot1/cam";
/// The acts in which nothing breaks come first.
const UNBROKEN: usize = 3;
/// In a shorter show, a host that is gone would not be noticed before it is back.
const WHOLE_S: u32 = 12;
