//! Reports the free space for episodes.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::time::Duration;

use rapid_status::Board;
use rapid_system::disk::Disk;
use tokio::task::spawn_blocking;
use tokio::time::sleep;

/// Interval of the reports; the recorder itself watches more closely.
const LOOK_EVERY: Duration = Duration::from_secs(5);

/// Reports the free space on the disk of `out`, or of the folder in which it will be created. Never ends. Cancel-safe.
pub(super) async fn watch(out: &Path, board: &Board) -> ! {
    loop {
        let folder = out.to_owned();
        // A disk that hangs delays this report alone.
        board.set_disk_free(spawn_blocking(move || free(&folder)).await.ok().flatten());
        sleep(LOOK_EVERY).await;
    }
}

fn free(folder: &Path) -> Option<u64> {
    let absolute: PathBuf = std::path::absolute(folder).ok()?;
    let open = absolute.ancestors().find_map(|folder| File::open(folder).ok())?;
    Disk::of_file(&open).ok().map(|disk| disk.free)
}
