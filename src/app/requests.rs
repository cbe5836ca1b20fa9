//! Requests of the screen and of other programs, sorted by receiver.
//!
//! Invariant: a request to the rig never waits for a file: it does not pass through the conductor, which waits for
//! files to be closed. Orders to the actuator take a separate path ([`crate::permission`]).

use tokio::sync::{mpsc, oneshot};
use tokio::task::spawn_blocking;

use crate::orders::receive::Asked;
use crate::rig::RigCommand;
use crate::status::Command;
use crate::status::session::SessionRequest;
use crate::time::Stamp;

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

/// Sorts requests until the screen, and what receives those of other programs, have ended. Those to the conductor wait in
/// an unbounded queue: a person types them, and other programs wait for an answer to each.
pub(super) fn sorted(
    conductor: mpsc::UnboundedSender<Request>,
    mut screen: mpsc::Receiver<Command>,
    mut asked: mpsc::Receiver<Asked>,
    rig: mpsc::Sender<RigCommand>,
    scenario: mpsc::UnboundedSender<String>,
) {
    let to_conductor = conductor.clone();
    tokio::spawn(async move {
        while let Some(asked) = asked.recv().await {
            let (reply, answer) = oneshot::channel();
            let request = Request::Session(asked.request.clone(), asked.at, Some(reply));
            // A receiver is gone only when the run ends; so is then the other end of the answer.
            let _ = to_conductor.send(request);
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
                Command::Restart(id) => rig.send(RigCommand::Restart(id)).await.is_ok(),
            };
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::modality::ModalityId;

    #[tokio::test]
    async fn the_rig_is_reached_while_the_conductor_is_busy() {
        let (screen, from_screen) = mpsc::channel(1);
        let (rig, mut at_rig) = mpsc::channel(1);
        let (conductor, mut requests) = mpsc::unbounded_channel();
        sorted(conductor, from_screen, mpsc::channel(1).1, rig, mpsc::unbounded_channel().0);
        for _ in 0..100 {
            screen.send(Command::Session(SessionRequest::Toggle)).await.unwrap();
        }
        screen.send(Command::Restart(ModalityId::new(3).unwrap())).await.unwrap();
        assert_eq!(at_rig.recv().await, Some(RigCommand::Restart(ModalityId::new(3).unwrap())));
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
