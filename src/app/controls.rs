//! Controls of cameras that a screen sets while they stream.
//!
//! Invariant: a camera that answers slowly holds up neither its stream nor the run: a control is set beside both.

use std::path::Path;
use std::sync::Arc;

use rapid_core::modality::ModalityId;
use rapid_devices::driver::camera;
use rapid_status::{Board, EventKind, Level};
use tokio::task::spawn_blocking;

/// Sets a control, and reports what came of it in the log, which the episode in progress contains.
pub(super) fn set(board: &Arc<Board>, id: ModalityId, control: String, value: i64) {
    let board = Arc::clone(board);
    tokio::spawn(async move {
        let Some(device) = board.name(id) else { return };
        let node = board.node(id).filter(|node| node.starts_with("/dev/"));
        let name = control.clone();
        let set = match node {
            None => Err("it is not an open camera of this machine".to_owned()),
            Some(node) => spawn_blocking(move || camera::set_control(Path::new(&node), &name, value))
                .await
                .unwrap_or_else(|_| Err("setting it panicked; please report this".to_owned())),
        };
        let (level, text) = match set {
            Ok(now) => {
                board.set_control(id, &control, now);
                let lasting = "`controls` in devices.toml is what lasts";
                (Level::Info, format!("{device}: {control} is {now} until it is opened again; {lasting}"))
            }
            Err(why) => (Level::Warn, format!("{device}: {control} is not set: {why}")),
        };
        board.announce(EventKind::Log { level, text });
    });
}
