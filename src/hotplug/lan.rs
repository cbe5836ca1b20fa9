//! Devices on the network: those that announce themselves (mDNS) and those at a fixed address.
//!
//! Registration is parallel to USB: each entry that is found by mDNS or by its address is looked for, and
//! nothing else on the network is. What was found is told as `Added` with the entry's name; it is told as
//! `Removed`
//!
//! * at once when the link that leads to it is down ([`UnplugSource::Link`]), and a second after it says goodbye
//!   ([`UnplugSource::Goodbye`]), in which another may say that it is there (RFC 6762, 10.1),
//! * otherwise when nothing of it was heard for the entry's lease, or its address says that nobody is there and its
//!   driver did not hear it either ([`UnplugSource::Lease`]).
//!
//! What a driver hears counts: a device that sends is not asked, and one whose announcements are lost in the
//! air while its pictures arrive is there.
//!
//! Invariant: what is found is bounded and told as it is; whoever shows it makes it harmless.
//! Invariant: nothing here waits for a device without an end, and nothing waits for anything here.

mod mdns;
mod probe;
mod watch;

use std::pin::Pin;
use std::task::{Context, Poll};
use std::time::Duration;

use futures::Stream;
use tokio::sync::mpsc;
use tokio::task::JoinSet;

use self::mdns::Browser;
use self::watch::Watch;
use super::{HotplugError, HotplugEvent};
use crate::registry::{LanFind, NodeSpec, Probe, Registry};

/// Events that may wait; the rig reads them at once.
const DEPTH: usize = 64;

/// See the module's comment.
pub struct LanMonitor {
    events: mpsc::Receiver<HotplugEvent>,
    /// Ended with this.
    _tasks: JoinSet<()>,
    _browser: Option<Browser>,
}

impl LanMonitor {
    /// Begins to look for the entries that are to be found on the network; `None` if there are none.
    #[must_use]
    pub fn open(registry: &Registry) -> Option<Self> {
        let (tell, events) = mpsc::channel(DEPTH);
        let mut tasks = JoinSet::new();
        let mut announced: Vec<(&str, Vec<mdns::Wanted>)> = Vec::new();
        let mut phones = Vec::new();
        for spec in &registry.devices {
            let NodeSpec::Lan(lan) = &spec.node else { continue };
            let watch = || Watch::new(&spec.name, lan.lease, tell.clone());
            match &lan.find {
                LanFind::Adapter { .. } => {}
                LanFind::Host { host, probe, port } => {
                    // While the driver waits for the end of a cooldown, nobody hears packets.
                    let grace = if *probe == Probe::Udp { registry.rig.cooldown } else { Duration::ZERO };
                    tasks.spawn(probe::watch(watch().waits(grace), lan.server(*host), (*host, *port).into(), *probe));
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
            // Without a socket for mDNS, which was said, they are never found.
            if let Some(browser) = &browser {
                tasks.spawn(browser.watch(service, wanted));
            }
        }
        let is_nothing = tasks.is_empty();
        (!is_nothing).then_some(Self { events, _tasks: tasks, _browser: browser })
    }
}

/// What is taken of the name of an announced instance, for the fuzzer.
#[doc(hidden)]
pub fn fuzz_label(label: &str) {
    mdns::fuzz(label);
}

impl Stream for LanMonitor {
    type Item = Result<HotplugEvent, HotplugError>;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        match self.events.poll_recv(context) {
            Poll::Ready(Some(event)) => Poll::Ready(Some(Ok(event))),
            // Tasks that are gone find nothing more; what was found stays.
            Poll::Ready(None) | Poll::Pending => Poll::Pending,
        }
    }
}
