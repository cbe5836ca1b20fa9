//! Requests of the screen and of other programs, sorted by receiver.
//!
//! Invariant: a request to the rig never waits for a file: it does not pass through the conductor, which waits for
//! files to be closed. Nor does one about the registry. Orders to the actuator take a separate path ([`rapid_core::permission`]).

use std::sync::Arc;

use rapid_core::time::Stamp;
use rapid_status::session::{Asker, SessionRequest};
use rapid_status::{Command, RegistryRequest};
use tokio::sync::{mpsc, oneshot};
use tokio::task::spawn_blocking;

use super::attached::Attached;
use super::controls;
use crate::orders::receive::{Arrival, Wanted};
use crate::rig::RigCommand;

/// Receives the answer to a request: what was done, or why it was refused.
pub(super) type Reply = Option<oneshot::Sender<Result<String, String>>>;

/// A request to the conductor.
#[derive(Debug)]
pub(super) enum Request {
    /// A request to the session, made at this moment.
    Session(SessionRequest, Stamp, Reply),
    /// End the run.
    Quit,
}

/// Passes requests of a server's clients on to the conductor, as made when they arrive.
pub(super) fn asker(conductor: &mpsc::UnboundedSender<Request>) -> Asker {
    let conductor = conductor.clone();
    Arc::new(move |request, reply| {
        // Without a receiver the run is ending; so is then the other end of the answer.
        let _ = conductor.send(Request::Session(request, Stamp::now(), Some(reply)));
    })
}

#[derive(Debug)]
pub(super) struct Receivers {
    /// Its requests wait in an unbounded queue: a person types them, and other programs wait for an answer to each.
    pub(super) conductor: mpsc::UnboundedSender<Request>,
    pub(super) rig: mpsc::Sender<RigCommand>,
    pub(super) registry: mpsc::UnboundedSender<(RegistryRequest, Reply)>,
    pub(super) scenario: mpsc::UnboundedSender<String>,
}

/// Sorts the commands of screens, and the requests of other programs, until those who make them have ended.
pub(super) fn spawn_router(
    receivers: Receivers,
    mut screen: mpsc::Receiver<Command>,
    mut arrivals: mpsc::Receiver<Arrival>,
    attached: Attached,
) {
    let Receivers { conductor, rig, registry, scenario } = receivers;
    let (to_conductor, to_registry, board) = (conductor.clone(), registry.clone(), Arc::clone(attached.board()));
    tokio::spawn(async move {
        while let Some(arrival) = arrivals.recv().await {
            let asked = match arrival {
                Arrival::Asked(asked) => asked,
                Arrival::Viewer(viewer) => {
                    attached.attach(viewer);
                    continue;
                }
            };
            let (reply, answer) = oneshot::channel();
            // A receiver is gone only when the run ends; so is then the other end of the answer.
            let _ = match asked.request.clone() {
                Wanted::Session(request) => to_conductor.send(Request::Session(request, asked.at, Some(reply))).is_ok(),
                Wanted::Registry(request) => to_registry.send((request, Some(reply))).is_ok(),
            };
            tokio::spawn(async move {
                let answer = answer.await.unwrap_or_else(|_| Err("the run is ending".to_owned()));
                let _ = spawn_blocking(move || asked.answer(answer)).await;
            });
        }
    });
    tokio::spawn(async move {
        while let Some(command) = screen.recv().await {
            // A receiver is gone only when the run ends.
            let _ = match command {
                Command::Session(request) => conductor.send(Request::Session(request, Stamp::now(), None)).is_ok(),
                Command::Quit => conductor.send(Request::Quit).is_ok(),
                Command::Plug(device) => scenario.send(device).is_ok(),
                Command::Control { device, name, value } => {
                    controls::set(&board, device, name, value);
                    true
                }
                Command::Look(id) => {
                    board.look(id, Stamp::now());
                    true
                }
                Command::Reload => registry.send((RegistryRequest::Reload, None)).is_ok(),
                Command::Register { device, name } => {
                    registry.send((RegistryRequest::Register { device, name }, None)).is_ok()
                }
                Command::Restart(id) => rig.send(RigCommand::Restart(id)).await.is_ok(),
            };
        }
    });
}

#[cfg(test)]
mod tests {
    use crate::literal::board;
    use rapid_core::modality::ModalityId;

    use super::*;

    #[tokio::test]
    async fn the_rig_is_reached_while_the_conductor_is_busy() {
        let (screen, from_screen) = mpsc::channel(1);
        let (rig, mut at_rig) = mpsc::channel(1);
        let attached = Attached::new(Arc::new(board(&["a"])), mpsc::channel(1).0);
        let (conductor, mut requests) = mpsc::unbounded_channel();
        let (registry, mut at_registry) = mpsc::unbounded_channel();
        let receivers = Receivers { conductor, rig, registry, scenario: mpsc::unbounded_channel().0 };
        spawn_router(receivers, from_screen, mpsc::channel(1).1, attached);
        for _ in 0..100 {
            screen.send(Command::Session(SessionRequest::Toggle)).await.unwrap();
        }
        screen.send(Command::Restart(ModalityId::new(3).unwrap())).await.unwrap();
        assert!(matches!(at_rig.recv().await, Some(RigCommand::Restart(id)) if id.bit() == 3));
        screen.send(Command::Reload).await.unwrap();
        assert!(matches!(at_registry.recv().await, Some((RegistryRequest::Reload, None))));
        screen.send(Command::Quit).await.unwrap();
        drop(screen);
        let mut all = Vec::new();
        while let Some(one) = requests.recv().await {
            all.push(one);
        }
        assert_eq!(all.len(), 101);
        assert!(matches!(all.last(), Some(Request::Quit)));
    }
}
