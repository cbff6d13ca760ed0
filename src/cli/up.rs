//! `ddx up`: serves this host in the foreground until SIGTERM or SIGINT.

use std::path::{Path, PathBuf};

use anyhow::Context as _;
use ddx_wire::seal::DomainKey;
use ddx_wire::{DomainId, HostName};
use serde_json::json;

use super::Context;
use super::interrupt::Interrupt;
use super::output::Output;
use crate::config::Config;
use crate::error::{Exit, Failure, Hint as _, Outcome};
use crate::host::{self, Ready};
use crate::manager::Manager;

/// What overrides the configuration.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Name of this host, the prefix of its items [default: the system's host name]
    #[arg(long, value_name = "NAME")]
    host: Option<String>,
    /// Hosts of different domains do not see each other [default: 0]
    #[arg(long, value_name = "N")]
    domain: Option<u16>,
    /// File with the domain key; without one nothing is sent or listened to on any network
    #[arg(long, value_name = "FILE")]
    key: Option<PathBuf>,
    /// Network interface to use, by name or address; may be repeated; may come up later [default: each that is up]
    #[arg(long, value_name = "NAME")]
    iface: Vec<String>,
    /// Host to ask at the start, as `udp/host:port`; may be repeated
    #[arg(long, value_name = "ENDPOINT")]
    join: Vec<String>,
    /// Configuration file [default: /etc/ddx/ddx.toml, if there]
    #[arg(long, value_name = "FILE", env = "DDX_CONFIG")]
    config: Option<PathBuf>,
}

/// Runs the verb.
pub(crate) fn run(context: &mut Context, args: Args) -> Outcome {
    let mut config = Config::load(args.config.as_deref())?;
    override_by(&mut config, context, args)?;
    let config = host_config(config)?;
    let interrupt = Interrupt::listen(context.tethered)?;
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .context("start the event loop")?;
    let out = &mut context.out;
    let mut said = Ok(());
    runtime.block_on(host::run(
        config,
        |ready| said = announce(out, ready),
        interrupt.raised(),
    ))?;
    said?;
    Ok(Exit::Done)
}

fn override_by(config: &mut Config, context: &Context, args: Args) -> Result<(), Failure> {
    if let Some(host) = args.host {
        config.host = HostName::parse(&host)
            .with_context(|| format!("--host `{host}`"))
            .arguments()?;
    }
    config.domain = args.domain.unwrap_or(config.domain);
    config.key = args.key.or(config.key.take());
    config.socket = context.socket.clone().or(config.socket.take());
    if !args.iface.is_empty() {
        config.iface = args.iface;
    }
    if !args.join.is_empty() {
        config.join = args.join;
    }
    Ok(())
}

fn host_config(config: Config) -> Result<host::Config, Failure> {
    Ok(host::Config {
        host: config.host,
        domain: DomainId(config.domain),
        key: config.key.as_deref().map(read_key).transpose()?,
        socket: config.socket,
        interfaces: config.iface,
        join: config.join,
        control_port: config.control_port,
        data_port: config.data_port,
        beacon: config.beacon,
        multicast: config.multicast,
        spin: config.spin,
        quotas: config.quotas,
    })
}

fn read_key(path: &Path) -> Result<DomainKey, Failure> {
    let text = std::fs::read_to_string(path)
        .with_context(|| format!("cannot read the key `{}`", path.display()))
        .hint(|| {
            format!(
                "`ddx key new > {}` makes one; copy it to each host of the domain",
                path.display()
            )
        })?;
    DomainKey::parse(text.trim())
        .with_context(|| format!("`{}` holds no domain key", path.display()))
        .hint(|| "a key is the one line that `ddx key new` prints".to_owned())
}

/// Tells people, programs and systemd that this host serves.
fn announce(out: &mut Output, ready: &Ready) -> anyhow::Result<()> {
    let network = match ready.data_port {
        Some(port) if ready.control.is_empty() => {
            format!("samples on UDP port {port}, once a network interface is up: waiting for one")
        }
        Some(port) => format!("samples on UDP port {port}"),
        None => "no key, no network".to_owned(),
    };
    out.either(
        &json!({
            "ready": true,
            "host": ready.host.as_str(),
            "domain": ready.domain.0,
            "socket": ready.socket,
            "control": ready.control,
            "data_port": ready.data_port,
        }),
        &format!(
            "ready: host {} in domain {} at {}; {network}",
            ready.host,
            ready.domain.0,
            ready.socket.display()
        ),
    )?;
    if let Some(manager) = Manager::from_env()? {
        manager
            .ready()
            .context("tell the service manager that we are ready")?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_missing_key_file_is_named_with_the_way_to_make_one() {
        let refused = read_key(Path::new("/nonexistent/k"))
            .unwrap_err()
            .to_string();

        assert!(
            refused.contains("cannot read the key `/nonexistent/k`"),
            "{refused}"
        );
        assert!(
            refused.contains("hint: `ddx key new > /nonexistent/k`"),
            "{refused}"
        );
    }
}
