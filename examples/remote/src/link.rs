//! The configuration of zenoh: only what the command line names is connected to, nothing is searched for.

use zenoh::{Config, Session};

use crate::Fault;
use crate::cli::Network;

/// Bytes that the kernel may hold for a connection: a second of a slow link would otherwise wait in it. 64 KiB are sent
/// in a round of 5 ms at 13 MB/s, 256 KiB in one of 100 ms at 2.5 MB/s.
const SEND_BUFFER: &str = "so_sndbuf=262144";

/// Opens a session that listens and connects there.
pub async fn open(network: &Network, listen: &[String], connect: &[String]) -> Result<Session, Fault> {
    let mut config = match &network.zenoh {
        Some(file) => Config::from_file(file).map_err(|error| format!("--zenoh {}: {error}", file.display()))?,
        None => Config::default(),
    };
    let mut set = |key: &str, value: String| {
        config.insert_json5(key, &value).map_err(|error| format!("zenoh: {key} = {value}: {error}"))
    };
    if network.zenoh.is_none() {
        set("scouting/multicast/enabled", "false".to_owned())?;
        set("scouting/gossip/enabled", "false".to_owned())?;
        // A connection whose network went is closed and made again; without this it hangs for ten seconds and more.
        set("transport/link/tx/lease", "2000".to_owned())?;
        set("transport/unicast/open_timeout", "2000".to_owned())?;
        set("connect/timeout_ms", "-1".to_owned())?;
        set("connect/exit_on_failure", "false".to_owned())?;
        let retry = "{ period_init_ms: 200, period_max_ms: 1000, period_increase_factor: 2 }";
        set("connect/retry", retry.to_owned())?;
    }
    let connect: Vec<String> = network.router.iter().chain(connect).map(|endpoint| bounded(endpoint)).collect();
    let mode = if network.router.is_some() { "client" } else { "peer" };
    if network.zenoh.is_none() || network.router.is_some() {
        set("mode", format!("{mode:?}"))?;
    }
    if !connect.is_empty() {
        set("connect/endpoints", list(&connect))?;
    }
    let listen: Vec<String> = listen.iter().map(|endpoint| bounded(endpoint)).collect();
    if !listen.is_empty() || network.zenoh.is_none() {
        set("listen/endpoints", list(&listen))?;
    }
    zenoh::open(config).await.map_err(|error| format!("zenoh: {error}").into())
}

fn list(endpoints: &[String]) -> String {
    format!("{endpoints:?}")
}

/// The endpoint with a bound for what waits in the kernel, unless it has settings of its own.
fn bounded(endpoint: &str) -> String {
    if endpoint.starts_with("tcp/") && !endpoint.contains('#') {
        format!("{endpoint}#{SEND_BUFFER}")
    } else {
        endpoint.to_owned()
    }
}
