//! Many episodes judged at once, on all processors.
//!
//! Every file is read whole, whatever its recorder wrote about it: what changed since then shows.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc;
use std::thread;

use super::progress::Bar;

/// Applies `read` to every file and hands the results to `take`, in the order of the files, each as soon as it is
/// there. On a terminal a line on standard error shows how far that is.
///
/// # Errors
/// The first of `take`; the files that are left are then not read.
pub(super) fn each<T: Send, E>(
    files: &[PathBuf],
    read: impl Fn(&Path) -> T + Sync,
    mut take: impl FnMut(&Path, T) -> Result<(), E>,
) -> Result<(), E> {
    let workers = thread::available_parallelism().map_or(1, usize::from).min(files.len());
    let mut bar = Bar::new("episodes", files.len(), files.len() > 1);
    let next = AtomicUsize::new(0);
    thread::scope(|scope| {
        let (done, results) = mpsc::sync_channel(2 * workers);
        for _ in 0..workers {
            let (done, next, read) = (done.clone(), &next, &read);
            scope.spawn(move || {
                loop {
                    let index = next.fetch_add(1, Ordering::Relaxed);
                    // Results have no reader any more after an error.
                    let Some(file) = files.get(index) else { break };
                    if done.send((index, read(file))).is_err() {
                        break;
                    }
                }
            });
        }
        drop(done);
        let mut early = BTreeMap::new();
        let mut index = 0;
        for (done, result) in results {
            early.insert(done, result);
            while let Some((file, result)) = files.get(index).zip(early.remove(&index)) {
                index += 1;
                bar.clear();
                take(file, result)?;
            }
            bar.at(index);
        }
        Ok(())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn results_come_in_the_order_of_the_files_until_an_error() {
        let files: Vec<PathBuf> = (0..500).map(|number| PathBuf::from(number.to_string())).collect();
        let number = |file: &Path| file.to_str().unwrap().parse::<usize>().unwrap();
        let mut taken = Vec::new();
        each(&files, number, |file, read| {
            assert_eq!(file, files[read]);
            taken.push(read);
            Ok::<_, ()>(())
        })
        .unwrap();
        assert_eq!(taken, (0..500).collect::<Vec<_>>());
        let stopped = each(&files, number, |_, read| if read == 7 { Err(read) } else { Ok(()) });
        assert_eq!(stopped, Err(7));
        assert_eq!(each(&[], number, |_, read| Err(read)), Ok(()));
    }
}
