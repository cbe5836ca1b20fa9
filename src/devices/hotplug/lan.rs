//! Devices on the network: those that announce themselves (mDNS) and those at a fixed address.
//!
//! Registration is parallel to USB: only entries identified by mDNS or by address are searched for, and nothing else on
//! the network. A device that is found is reported as `Added` with the entry's name; it is reported as
//! `Removed`
//!
//! * at once when the link that leads to it is down (`UnplugSource::Link`), and a second after its goodbye
//!   (`UnplugSource::Goodbye`), during which another device may announce itself (RFC 6762, 10.1),
//! * otherwise when nothing was received from it for the entry's lease, or its address reports that no device is there
//!   and its driver received nothing either (`UnplugSource::Lease`).
//!
//! A driver's reception counts: a device that sends is not queried, and one whose announcements are lost on the network
//! while its pictures arrive is present.
//!
//! Invariant: discovered data is bounded and reported unchanged; the code that displays it escapes it.
//! Invariant: every wait for a device is bounded, and nothing else waits for this module.

mod mdns;
mod probe;
mod watch;

use std::pin::Pin;
use std::task::{Context, Poll};
use std::time::Duration;

use futures::Stream;
use rapid_registry::{DeviceSpec, LanFind, NodeSpec, Probe};
use tokio::sync::mpsc;
use tokio::task::JoinSet;

use self::mdns::Browser;
use self::probe::Question;
use self::watch::Watch;
use super::{HotplugError, HotplugEvent};

/// Queue length for events; the rig reads them at once.
const DEPTH: usize = 64;

/// See the module's comment.
pub struct LanMonitor {
    events: mpsc::Receiver<HotplugEvent>,
    /// Aborted when this is dropped.
    _tasks: JoinSet<()>,
    _browser: Option<Browser>,
}

impl LanMonitor {
    /// Starts searching for those of these entries that are found on the network; `None` if there are none. `cooldown` is that
    /// of the rig. Two monitors of one service may give one device to both, unless their entries name different instances.
    pub fn open<'a>(devices: impl IntoIterator<Item = &'a DeviceSpec>, cooldown: Duration) -> Option<Self> {
        let (report, events) = mpsc::channel(DEPTH);
        let mut tasks = JoinSet::new();
        let mut announced: Vec<(&str, Vec<mdns::Wanted>)> = Vec::new();
        let mut phones = Vec::new();
        for spec in devices {
            let NodeSpec::Lan(lan) = &spec.node else { continue };
            let watch = || Watch::new(&spec.name, lan.lease, report.clone());
            match &lan.find {
                LanFind::Adapter { .. } => {}
                LanFind::Host { host, probe, port } => {
                    // While the driver waits for the end of a cooldown, no packets are received.
                    let grace = if *probe == Probe::Udp { cooldown } else { Duration::ZERO };
                    let question = match lan.request() {
                        Some(request) => Question::Remote(request),
                        None => (*probe).into(),
                    };
                    tasks.spawn(probe::watch(watch().waits(grace), lan.server(*host), (*host, *port).into(), question));
                }
                LanFind::Mdns { service, instance } => {
                    let wanted = mdns::Wanted::new(watch(), instance.clone(), lan);
                    match announced.iter_mut().find(|(known, _)| known == service) {
                        Some((_, all)) => all.push(wanted),
                        None => announced.push((service, vec![wanted])),
                    }
                    phones.extend(lan.own_port().and_then(|(is_udp, port)| (!is_udp).then_some(port)));
                }
            }
        }
        let browser = if announced.is_empty() { None } else { Browser::open(&phones) };
        for (service, wanted) in announced {
            // Without an mDNS socket, which was reported, they are never found.
            if let Some(browser) = &browser {
                tasks.spawn(browser.watch(service, wanted));
            }
        }
        let is_nothing = tasks.is_empty();
        (!is_nothing).then_some(Self { events, _tasks: tasks, _browser: browser })
    }
}

/// The part of an announced instance's name that is used, for the fuzzer.
#[doc(hidden)]
pub fn fuzz_label(label: &str) {
    mdns::fuzz(label);
}

impl Stream for LanMonitor {
    type Item = Result<HotplugEvent, HotplugError>;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        match self.events.poll_recv(context) {
            Poll::Ready(Some(event)) => Poll::Ready(Some(Ok(event))),
            // Tasks that have ended find nothing more; earlier findings remain.
            Poll::Ready(None) | Poll::Pending => Poll::Pending,
        }
    }
}
