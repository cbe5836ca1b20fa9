//! Notes are read as they were written, changed one by one, and never replaced by what is not understood.

use std::fs;

use proptest::prelude::*;
use rapid_status::session::{Label, Mark};
use rapid_system::folder::{Links, Missing};

use super::*;

fn opened(folder: &Path) -> Folder {
    Folder::open(folder, Links::Own, Missing::Refused).unwrap()
}

fn changes() -> impl Strategy<Value = Vec<NotesChange>> {
    let label = prop_oneof![Just(None), Just(Some(Label::Success)), Just(Some(Label::Failure))];
    let text = "[ -~\\n\\t\"'#\\\\äß\u{1f916}\u{0}\u{7f}]{0,12}";
    let change = prop_oneof![
        (label, text).prop_map(|(label, reason)| NotesChange::Label(label, reason)),
        text.prop_map(NotesChange::Note),
        (0.0..1e9_f64, text).prop_map(|(at, text)| NotesChange::Mark(Mark { at, text })),
    ];
    prop::collection::vec(change, 0..8)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn what_is_noted_is_read_again(changes in changes()) {
        let folder = tempfile::tempdir().unwrap();
        let open = opened(folder.path());
        let mut expected = Notes::default();
        for one in &changes {
            expected.apply(one);
            let noted = change(&open, Path::new("a.mcap.partial"), Notes::default, std::slice::from_ref(one)).unwrap();
            prop_assert_eq!(&noted, &expected);
        }
        let read = read(&open, Path::new("a.mcap")).unwrap().unwrap_or_default();
        prop_assert_eq!(&read, &expected);
        // From nothing it is made again by its own changes.
        let mut again = Notes::default();
        expected.clone().into_changes().iter().for_each(|change| again.apply(change));
        // A reason without a label is the only thing that is nobody's.
        if expected.label.is_some() {
            prop_assert_eq!(again, expected);
        }
    }

    /// Whatever the file holds: an error with a line, or notes that can be computed with.
    #[test]
    fn any_file_is_an_error_with_its_line_or_notes(
        text in "(label|note|marks|at|text|\\[\\[|\\]\\]|=|\"|success|inf|-1|nan|1e400|\n|\\{|\\[| ){0,30}",
    ) {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join("a.mcap.toml"), &text).unwrap();
        match read(&opened(folder.path()), Path::new("a.mcap")) {
            Ok(notes) => {
                let marks = notes.unwrap().marks;
                prop_assert!(marks.iter().all(|mark| mark.at.is_finite() && mark.at >= 0.0));
            }
            Err(NotesError::Invalid { line, .. }) => prop_assert!((1..=text.lines().count() + 1).contains(&line)),
            Err(error) => return Err(TestCaseError::fail(error.to_string())),
        }
    }
}

#[test]
fn of_changes_made_at_the_same_time_none_is_lost() {
    let folder = tempfile::tempdir().unwrap();
    let (threads, each) = (4_u32, 25_u32);
    std::thread::scope(|scope| {
        for thread in 0..threads {
            let path = folder.path();
            scope.spawn(move || {
                let open = opened(path);
                for number in 0..each {
                    let mark = Mark { at: f64::from(thread * each + number), text: String::new() };
                    change(&open, Path::new("a.mcap"), Notes::default, &[NotesChange::Mark(mark)]).unwrap();
                }
            });
        }
    });
    let notes = read(&opened(folder.path()), Path::new("a.mcap")).unwrap().unwrap();
    let times: Vec<_> = (0..threads * each).map(f64::from).collect();
    assert_eq!(notes.marks.iter().map(|mark| mark.at).collect::<Vec<_>>(), times);
}

#[test]
fn deep_and_endless_files_are_errors() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.mcap.toml");
    let read = || read(&opened(folder.path()), Path::new("a.mcap"));
    fs::write(&path, ["note = ", &"[".repeat(100_000)].concat()).unwrap();
    assert!(matches!(read(), Err(NotesError::Invalid { .. })));
    fs::File::create(&path).unwrap().set_len(20 << 30).unwrap();
    assert!(read().is_err());
    fs::remove_file(&path).unwrap();
    fs::create_dir(&path).unwrap();
    assert!(matches!(read(), Err(NotesError::Io { .. })));
}
