//! Requests of the screen, sorted by receiver.
//!
//! Invariant: a request to the rig never waits for a file: it does not pass through the conductor, which waits for
//! files to be closed. Orders to the actuator take a separate path ([`crate::permission`]).

use std::path::PathBuf;

use tokio::sync::mpsc;

use crate::rig::RigCommand;
use crate::status::Command;
use crate::time::Stamp;

/// A request to the conductor.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Request {
    /// Begin an episode, or end the one in progress at this moment.
    ToggleRecording(Stamp),
    /// Remove this file, the last episode.
    DropEpisode(PathBuf),
    /// End the run.
    Quit,
}

/// Sorts requests of the screen until it has ended. Those to the conductor wait in an unbounded queue: a person types
/// them.
pub(super) fn sorted(
    mut screen: mpsc::Receiver<Command>,
    rig: mpsc::Sender<RigCommand>,
) -> mpsc::UnboundedReceiver<Request> {
    let (conductor, requests) = mpsc::unbounded_channel();
    tokio::spawn(async move {
        while let Some(command) = screen.recv().await {
            // A receiver is gone only when the run ends.
            let _ = match command {
                Command::ToggleRecording => conductor.send(Request::ToggleRecording(Stamp::now())).is_ok(),
                Command::DropEpisode(file) => conductor.send(Request::DropEpisode(file)).is_ok(),
                Command::Quit => conductor.send(Request::Quit).is_ok(),
                Command::Restart(id) => rig.send(RigCommand::Restart(id)).await.is_ok(),
            };
        }
    });
    requests
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::modality::ModalityId;

    #[tokio::test]
    async fn the_rig_is_reached_while_the_conductor_is_busy() {
        let (screen, from_screen) = mpsc::channel(1);
        let (rig, mut at_rig) = mpsc::channel(1);
        let mut requests = sorted(from_screen, rig);
        for _ in 0..100 {
            screen.send(Command::ToggleRecording).await.unwrap();
        }
        screen.send(Command::Restart(ModalityId::new(3).unwrap())).await.unwrap();
        assert_eq!(at_rig.recv().await, Some(RigCommand::Restart(ModalityId::new(3).unwrap())));
        screen.send(Command::Quit).await.unwrap();
        drop(screen);
        let mut all = Vec::new();
        while let Some(one) = requests.recv().await {
            all.push(one);
        }
        assert_eq!((all.len(), all.last()), (101, Some(&Request::Quit)));
    }
}
