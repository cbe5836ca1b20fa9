//! Disk space for the episode in progress.
//!
//! Guarded twice: an episode ends before less than the reserve is free, and the space needed to close it is allocated
//! in advance after the end of the file, so that it can be closed even when another program takes the last byte, or the
//! user has no more (a quota). That a file may not become larger is the third: [`FileLimit`] is known from the start, and
//! the file itself stays below it.
//!
//! | free, above the reserve                     | then                                       |
//! |---------------------------------------------|--------------------------------------------|
//! | for [`WARN_LEFT`], and another reserve      |                                            |
//! | less, at the rate it is written with        | reported once, shown with the time left    |
//! | nothing                                     | the episode is closed, no other begins     |
//!
//! Invariant: free space includes the space set aside for the file.

use std::collections::VecDeque;
use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use rapid_core::text;
use rapid_core::time::Stamp;
use rapid_system::disk::{Disk, FileLimit, is_full};
use rustix::fs::{FallocateFlags, fallocate, fstat, ftruncate};
use rustix::io::Errno;

use super::RecordError;

/// Time left below which it is reported.
const WARN_LEFT: Duration = Duration::from_mins(5);
/// How often the space set aside is checked: at 300 MB/s half of [`ASIDE_MOST`] is written in that time.
const LOOK_EVERY: Duration = Duration::from_millis(100);
/// How often the free space of the disk is read.
const ASK_EVERY: Duration = Duration::from_secs(1);
/// The most that is set aside: a chunk, the data between two checks, and the summary, some 200 bytes per MiB of the
/// episode.
const ASIDE_MOST: u64 = 64 << 20;
/// The least that is set aside.
const ASIDE_LEAST: u64 = 4 << 20;
/// The rate is the mean over this long.
const RATE_OVER: Duration = Duration::from_secs(10);
/// No rate is computed over less than this.
const RATE_LEAST: Duration = Duration::from_secs(2);
/// Longer times are not forecast.
const LEFT_MOST: Duration = Duration::from_hours(100);

/// What to do about a disk or a quota that is full.
pub(super) const MAKE_ROOM: &str = "remove or move recordings, or choose another folder with --out";

/// Reads the free space on the disk of a file; only tests replace the answer of the file system.
pub type Asker = Box<dyn FnMut(&File) -> io::Result<Disk> + Send>;

/// The known disk space of an episode.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Room {
    Ample,
    /// Until the reserve is reached.
    Low(Duration),
    Spent,
}

/// The decision of the module's table; `rate` in bytes a second.
fn room(free: u64, reserve: u64, rate: f64) -> Room {
    let Some(above) = free.checked_sub(reserve) else { return Room::Spent };
    let seconds = above as f64 / rate.max(1.0);
    let left = Duration::try_from_secs_f64(seconds).map_or(LEFT_MOST, |left| left.min(LEFT_MOST));
    if left >= WARN_LEFT && above >= reserve { Room::Ample } else { Room::Low(left) }
}

/// A report to be made.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Finding {
    /// Nearly full; reported once an episode.
    Low {
        /// What is free, bytes.
        free: u64,
        /// Until the episode will be closed.
        left: Duration,
    },
    /// The reason why the episode must be closed now.
    Spent(String),
    /// The file will soon be as large as it may become; reported once an episode.
    FileLimit(String),
    /// The file has no name any more; reported once.
    Removed,
}

/// The room of one episode.
pub(super) struct Space {
    file: Arc<File>,
    limit: FileLimit,
    /// Sets space aside; only tests replace it.
    allocate: fn(&File, u64, u64) -> Result<(), Errno>,
    folder: PathBuf,
    reserve: u64,
    /// How much is set aside ahead of the end of the file; none where the file system cannot.
    aside: Option<u64>,
    /// Where what is set aside ends.
    allocated: u64,
    looked: Stamp,
    asked: Stamp,
    sizes: VecDeque<(Stamp, u64)>,
    left: Option<Duration>,
    reported_low: bool,
    reported_limit: bool,
    reported_removed: bool,
}

impl Space {
    /// Begins to watch over `file`, which may grow to `limit` and lies in `folder`, of a disk of which `reserve` stays free.
    ///
    /// # Errors
    /// When there is no room for an episode.
    pub(super) fn begin(
        file: Arc<File>,
        limit: FileLimit,
        folder: &Path,
        reserve: Option<u64>,
        now: Stamp,
        ask: &mut Asker,
    ) -> Result<Self, RecordError> {
        if limit.bytes < ASIDE_LEAST {
            return Err(RecordError::FileLimit { folder: folder.to_owned(), limit });
        }
        // Without a known size the disk is used anyway.
        let disk = ask(&file).unwrap_or(Disk { free: u64::MAX, size: 0 });
        let reserve = disk.reserve(reserve);
        let mut space = Self {
            file,
            limit,
            allocate: |file, from, length| fallocate(file, FallocateFlags::KEEP_SIZE, from, length),
            folder: folder.to_owned(),
            reserve,
            aside: Some((reserve / 2).clamp(ASIDE_LEAST, ASIDE_MOST)),
            allocated: 0,
            looked: now,
            asked: now,
            sizes: VecDeque::from([(now, 0)]),
            left: None,
            reported_low: false,
            reported_limit: false,
            reported_removed: false,
        };
        let full = |free| RecordError::NoRoom { folder: folder.to_owned(), free, reserve };
        if disk.size > 0 && room(disk.free, reserve, 0.0) == Room::Spent {
            return Err(full(disk.free));
        }
        match space.set_aside(0) {
            Ok(()) => Ok(space),
            Err(_) => Err(full(disk.free)),
        }
    }

    /// Checks the room, at most every [`LOOK_EVERY`].
    pub(super) fn check(&mut self, now: Stamp, ask: &mut Asker) -> Option<Finding> {
        if now.since(self.looked) < LOOK_EVERY {
            return None;
        }
        self.looked = now;
        let stat = fstat(&self.file).ok()?;
        let size = u64::try_from(stat.st_size).unwrap_or(0);
        if let Err(error) = self.set_aside(size) {
            let folder = self.folder.display();
            return Some(Finding::Spent(format!(
                "{folder}: {}, and the episode was closed with what had been set aside for that; {MAKE_ROOM}",
                io::Error::from(error)
            )));
        }
        if now.since(self.asked) < ASK_EVERY {
            return None;
        }
        self.asked = now;
        let rate = self.rate(now, size);
        if let Ok(disk) = ask(&self.file)
            && disk.size > 0
        {
            let free = disk.free.saturating_add(self.allocated.saturating_sub(size));
            let room = room(free, self.reserve, rate);
            self.left = if let Room::Low(left) = room { Some(left) } else { None };
            match room {
                Room::Spent => return Some(Finding::Spent(self.spent(free))),
                Room::Low(left) if !std::mem::replace(&mut self.reported_low, true) => {
                    return Some(Finding::Low { free, left });
                }
                Room::Low(_) | Room::Ample => {}
            }
        }
        if stat.st_nlink == 0 && !std::mem::replace(&mut self.reported_removed, true) {
            return Some(Finding::Removed);
        }
        self.near_limit(size, rate)
    }

    /// The report that the file will soon be as large as it may become.
    fn near_limit(&mut self, size: u64, rate: f64) -> Option<Finding> {
        let seconds = self.limit.bytes.saturating_sub(size) as f64 / rate.max(1.0);
        let left = Duration::try_from_secs_f64(seconds).ok().filter(|left| *left < WARN_LEFT)?;
        self.left = Some(self.left.map_or(left, |disk| disk.min(left)));
        let is_new = !std::mem::replace(&mut self.reported_limit, true);
        is_new.then(|| {
            let (folder, seconds, limit) = (self.folder.display(), left.as_secs(), self.limit);
            Finding::FileLimit(format!("{folder}: the episode will be closed in about {seconds} s: {limit}"))
        })
    }

    /// Time left while the disk is nearly full.
    pub(super) fn left(&self) -> Option<Duration> {
        self.left
    }

    /// Gives back what is set aside and was not needed.
    pub(super) fn release(self) {
        let size = fstat(&self.file).map(|stat| u64::try_from(stat.st_size).unwrap_or(0));
        if let Ok(size) = size.map_err(|error| tracing::debug!(%error, "no size"))
            && self.allocated > size
            && let Err(error) = ftruncate(&self.file, size)
        {
            tracing::warn!(folder = %self.folder.display(), %error, "what was set aside is not given back");
        }
    }

    fn spent(&self, free: u64) -> String {
        format!(
            "{}: the disk is nearly full, {} free: the episode was closed to keep {} free (disk_reserve); {MAKE_ROOM}",
            self.folder.display(),
            text::size(free),
            text::size(self.reserve)
        )
    }

    /// Ensures that at least half of `aside` is set aside after `size`.
    fn set_aside(&mut self, size: u64) -> Result<(), Errno> {
        let Some(aside) = self.aside else { return Ok(()) };
        if self.allocated >= size.saturating_add(aside / 2) && self.allocated > 0 {
            return Ok(());
        }
        let end = size.saturating_add(aside).min(self.limit.bytes);
        if end <= self.allocated {
            return Ok(());
        }
        match (self.allocate)(&self.file, self.allocated, end - self.allocated) {
            Ok(()) => self.allocated = end,
            // Tried again at the next look.
            Err(Errno::INTR) => {}
            Err(full) if is_full(&full.into()) => return Err(full),
            Err(error) => {
                tracing::debug!(%error, "nothing can be set aside on this file system");
                self.aside = None;
            }
        }
        Ok(())
    }

    /// Bytes a second, recently.
    fn rate(&mut self, now: Stamp, size: u64) -> f64 {
        while self.sizes.get(1).is_some_and(|(at, _)| now.since(*at) >= RATE_OVER) {
            self.sizes.pop_front();
        }
        self.sizes.push_back((now, size));
        let Some((first, before)) = self.sizes.front() else { return 0.0 };
        let over = now.since(*first);
        if over < RATE_LEAST { 0.0 } else { size.saturating_sub(*before) as f64 / over.as_secs_f64() }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const GIB: u64 = 1 << 30;

    #[test]
    fn the_room_is_judged_by_reserve_and_rate() {
        let low = |seconds| Room::Low(Duration::from_secs(seconds));
        for (free, reserve, rate, expected) in [
            (100 * GIB, GIB, 0.0, Room::Ample),
            // 99 GiB last an hour at 28 MiB/s and four minutes at 422 MiB/s.
            (100 * GIB, GIB, 28.0 * 1_048_576.0, Room::Ample),
            (241 * 1_000_000 + GIB, GIB, 1e6, low(241)),
            (2 * GIB, GIB, 0.0, Room::Ample),
            (2 * GIB - 1, GIB, 0.0, Room::Low(LEFT_MOST)),
            (GIB + 30_000_000, GIB, 30e6, low(1)),
            (GIB, GIB, 30e6, low(0)),
            (GIB - 1, GIB, 0.0, Room::Spent),
            (0, 0, 1e6, low(0)),
            (u64::MAX, 0, 0.0, Room::Ample),
        ] {
            assert_eq!(room(free, reserve, rate), expected, "{free} {reserve} {rate}");
        }
    }

    #[test]
    fn a_small_disk_keeps_a_twentieth_by_default() {
        let disk = |size| Disk { free: 0, size };
        assert_eq!(disk(200 * GIB).reserve(None), GIB);
        assert_eq!(disk(64 << 20).reserve(None), (64 << 20) / 20);
        assert_eq!(disk(64 << 20).reserve(Some(5)), 5);
    }

    proptest! {
        /// More room is never judged worse, and a higher rate never better.
        #[test]
        fn the_judgement_is_monotonic(
            free in 0..8 * GIB, more in 0..8 * GIB, reserve in 0..4 * GIB, rate in 0.0..1e9, faster in 0.0..1e9
        ) {
            let order = |room| match room {
                Room::Spent => Duration::ZERO,
                Room::Low(left) => left + Duration::from_nanos(1),
                Room::Ample => Duration::MAX,
            };
            prop_assert!(order(room(free + more, reserve, rate)) >= order(room(free, reserve, rate)));
            prop_assert!(order(room(free, reserve, rate + faster)) <= order(room(free, reserve, rate)));
        }
    }

    #[test]
    fn reserved_space_lies_after_the_end_and_is_released() {
        let file = Arc::new(tempfile::tempfile().unwrap());
        let mut ask: Asker = Box::new(Disk::of_file);
        let blocks = |file: &File| fstat(file).unwrap().st_blocks;
        let space =
            Space::begin(Arc::clone(&file), FileLimit::NONE, Path::new("."), Some(0), Stamp(0), &mut ask).unwrap();
        assert_eq!(fstat(&file).unwrap().st_size, 0);
        if space.aside.is_none() {
            // A file system that cannot: nothing to be given back.
            return;
        }
        assert!(blocks(&file) * 512 >= i64::try_from(ASIDE_LEAST).unwrap());
        space.release();
        assert_eq!(blocks(&file), 0);
    }

    #[test]
    fn an_episode_is_closed_when_there_is_no_room_for_its_user_or_in_its_file() {
        for (error, is_full) in
            [(Errno::NOSPC, true), (Errno::DQUOT, true), (Errno::FBIG, true), (Errno::OPNOTSUPP, false)]
        {
            let file = Arc::new(tempfile::tempfile().unwrap());
            let mut ask: Asker = Box::new(Disk::of_file);
            let (limit, out) = (FileLimit::NONE, Path::new("out"));
            let mut space = Space::begin(Arc::clone(&file), limit, out, Some(0), Stamp(0), &mut ask).unwrap();
            if space.aside.is_none() {
                return;
            }
            space.allocate = match error {
                Errno::NOSPC => |_, _, _| Err(Errno::NOSPC),
                Errno::DQUOT => |_, _, _| Err(Errno::DQUOT),
                Errno::FBIG => |_, _, _| Err(Errno::FBIG),
                _ => |_, _, _| Err(Errno::OPNOTSUPP),
            };
            file.set_len(ASIDE_MOST).unwrap();
            let found = space.check(Stamp(0).after(LOOK_EVERY), &mut ask);
            let Some(Finding::Spent(why)) = found else {
                assert!(!is_full, "{error}: {found:?}");
                continue;
            };
            let is_explained = why.contains(&io::Error::from(error).to_string()) && why.contains("--out");
            assert!(is_full && is_explained && why.starts_with("out: "), "{error}: {why}");
        }
    }

    #[test]
    fn room_beside_an_episode_is_twice_the_reserve() {
        let disk = Disk { free: 1000, size: 4000 };
        assert!(
            !disk.lacks_room_beside_an_episode(200, Some(400)) && disk.lacks_room_beside_an_episode(201, Some(400))
        );
        // A twentieth of the disk.
        assert!(!disk.lacks_room_beside_an_episode(600, None) && disk.lacks_room_beside_an_episode(601, None));
    }
}
