//! `rapid export`: episodes become a dataset, or are appended to one.
//!
//! Episodes are surveyed in parallel, and so are their videos and rows written, each for the number that it has in the set if
//! all before it fit; names are given one episode after the other.
//!
//! Invariant: an episode that cannot be exported is named with the reason, and the others are exported nevertheless.

use std::collections::BTreeMap;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::thread;

use rapid_core::text;
use rapid_episode::record::inspect::{self, ReadError};
use rapid_episode::sha256;
use rapid_export::{
    self, Codec, DataSet, Difference, Encoded, Ends, Features, Ffmpeg, Known, NotExported, Pictures, Position, Refusal,
    SetError, Survey, Unfit, Verdicts, Verified,
};
use rapid_registry::ExportSpec;
use rapid_status::Grade;
use rapid_status::session::Notes;
use serde::{Serialize, Serializer};

use super::progress::Work;
use super::{Format, json_line};
use crate::cli::{ExportArgs, LabelFilter, PictureForm, VerdictArg};
use crate::session::noted::noted;

/// Why the export ended.
#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    /// The episodes cannot be listed.
    #[error(transparent)]
    Episodes(#[from] ReadError),
    /// Nothing to export.
    #[error("no episodes in {0}")]
    NoEpisodes(String),
    /// The dataset.
    #[error(transparent)]
    Set(#[from] SetError),
    /// No episode fits.
    #[error("nothing exported: none of {0} can be, for the reasons above")]
    Nothing(String),
    /// No episode is selected.
    #[error("nothing exported: none of {0} has what --label and --verdict select")]
    NotSelected(String),
    /// The user interrupted.
    #[error("interrupted; {} has {episodes}, and the same command continues", out.display())]
    Interrupted {
        /// The dataset.
        out: PathBuf,
        /// Its episodes.
        episodes: String,
    },
    /// Standard output.
    #[error("output: {0}")]
    Output(#[from] io::Error),
}

/// What became of an episode.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
enum Outcome {
    Exported,
    /// The set had it.
    Already,
    LeftOut,
}

/// A line about an episode.
#[derive(Debug, Serialize)]
struct Exported<'a> {
    #[serde(serialize_with = "text::lossy")]
    file: &'a Path,
    outcome: Outcome,
    /// Its number in the set.
    episode: Option<usize>,
    frames: Option<usize>,
    /// Samples that could not be used.
    unusable: Option<u64>,
    /// The same by sensor, and actions that no frame has.
    unfit: &'a [Unfit],
    verdict: Option<Grade>,
    /// Why it is left out.
    reason: Option<String>,
}

/// The last line.
#[derive(Debug, Serialize)]
struct Summary<'a> {
    #[serde(serialize_with = "text::lossy")]
    out: &'a Path,
    exported: usize,
    already: usize,
    left_out: usize,
    /// How many of those are BAD.
    bad: usize,
    /// Episodes that `--label` and `--verdict` do not select.
    not_selected: usize,
    /// Samples of exported episodes that belong to a frame and cannot be used.
    unusable: u64,
    /// What exported episodes have and the dataset does not, and in how many of them.
    #[serde(serialize_with = "listed")]
    not_exported: BTreeMap<NotExported, usize>,
    /// Episodes and frames of the set.
    episodes: usize,
    frames: u64,
    /// Frames compared with their episodes; `None` without `--verify`.
    verified: Option<usize>,
    differences: usize,
    /// How near the worst frame of a video is to its picture, dB; `None` without `--verify` and without videos.
    psnr_db: Option<f64>,
}

impl<'a> Summary<'a> {
    const fn new(out: &'a Path) -> Self {
        Self {
            out,
            exported: 0,
            already: 0,
            left_out: 0,
            bad: 0,
            not_selected: 0,
            not_exported: BTreeMap::new(),
            unusable: 0,
            episodes: 0,
            frames: 0,
            verified: None,
            differences: 0,
            psnr_db: None,
        }
    }
}

/// A list in JSON of what the dataset does not have.
fn listed<S: Serializer>(not_exported: &BTreeMap<NotExported, usize>, to: S) -> Result<S::Ok, S::Error> {
    #[derive(Serialize)]
    struct Line<'a> {
        #[serde(flatten)]
        what: &'a NotExported,
        episodes: usize,
    }
    to.collect_seq(not_exported.iter().map(|(what, episodes)| Line { what, episodes: *episodes }))
}

/// A line about a difference.
#[derive(Debug, Serialize)]
struct Differing<'a> {
    #[serde(serialize_with = "text::lossy")]
    file: &'a Path,
    episode: usize,
    #[serde(flatten)]
    difference: &'a Difference,
}

/// Exports the episodes that `args` names. A line for each goes to `out`, and to `err` for each that is left out; with
/// `--json` all are objects on `out`. `stop` interrupts after the episode so far. Returns whether the dataset is as the
/// episodes, as far as that was requested.
///
/// # Errors
/// When no episode fits, the dataset cannot be written, or `stop` was set.
pub fn export(
    args: &ExportArgs,
    format: Format,
    stop: &AtomicBool,
    out: &mut dyn Write,
    err: &mut dyn Write,
) -> Result<bool, ExportError> {
    let files = inspect::episodes(&args.paths)?;
    if files.is_empty() {
        let places: Vec<_> = args.paths.iter().map(|path| path.display().to_string()).collect();
        return Err(ExportError::NoEpisodes(places.join(", ")));
    }
    let mut set = DataSet::open(&args.out)?;
    let pictures = set.pictures(args.pictures.map(pictures))?;
    let ffmpeg = match pictures {
        Pictures::Files => None,
        Pictures::Video(codec) => {
            let found = Ffmpeg::find(args.ffmpeg.as_deref(), codec, &|| stop.load(Ordering::Relaxed));
            Some(found.map_err(SetError::from)?)
        }
    };
    let mut report = Report { format, out, err, summary: Summary::new(&args.out) };
    let noted = noted_of(&files, &mut report)?;
    let selected: Vec<PathBuf> = files.iter().filter(|file| has_label(args, noted.get(*file))).cloned().collect();
    report.summary.not_selected = files.len() - selected.len();
    let mut found = found(&selected, args, &set, stop, &mut report)?;
    for (number, file) in &found.already {
        if let Some(noted) = noted.get(file) {
            set.note(*number, noted)?;
        }
    }
    for episode in &mut found.new {
        episode.noted = noted.get(&episode.file).cloned().unwrap_or_default();
    }
    let mut sources = found.already;
    let fitting = fitting(found.new, args, pictures, &set, &mut report)?;
    append(&fitting, args.jobs, &mut set, ffmpeg.as_ref(), stop, &mut report, &mut sources)?;
    interrupted(&set, stop)?;
    if args.verify {
        verify(&set, args.jobs, &sources, ffmpeg.as_ref(), stop, &mut report)?;
        interrupted(&set, stop)?;
    }
    report.summary.episodes = set.episodes();
    report.summary.frames = set.rows();
    report.end()?;
    if sources.is_empty() {
        let episodes = text::counted(files.len() as u64, "episode");
        let is_selected = report.summary.not_selected < files.len();
        return Err(if is_selected { ExportError::Nothing(episodes) } else { ExportError::NotSelected(episodes) });
    }
    Ok(report.summary.differences == 0)
}

/// What people noted about these files.
fn noted_of(files: &[PathBuf], report: &mut Report<'_>) -> io::Result<BTreeMap<PathBuf, Notes>> {
    let mut warnings = Vec::new();
    let noted = noted(files, &mut |error| warnings.push(format!("warning: {error}")));
    for warning in warnings {
        writeln!(report.err, "{}", text::plain(&warning))?;
    }
    Ok(noted)
}

fn has_label(args: &ExportArgs, noted: Option<&Notes>) -> bool {
    args.label.is_empty() || args.label.contains(&LabelFilter::of(noted.and_then(|noted| noted.label)))
}

fn pictures(form: PictureForm) -> Pictures {
    match form {
        PictureForm::Jpeg => Pictures::Files,
        PictureForm::Av1 => Pictures::Video(Codec::Av1),
        PictureForm::H264 => Pictures::Video(Codec::H264),
    }
}

/// How many episodes are worked on at a time, `each` of which keeps so many processors busy.
fn workers(jobs: Option<u16>, each: usize) -> usize {
    let processors = thread::available_parallelism().map_or(1, usize::from);
    jobs.map_or_else(|| processors.div_ceil(each.max(1)), usize::from)
}

/// Appends episodes, in their order; their videos and rows are written before, of as many at a time as [`workers`]
/// gives.
fn append(
    fitting: &[(Survey, Features)],
    jobs: Option<u16>,
    set: &mut DataSet,
    ffmpeg: Option<&Ffmpeg>,
    stop: &AtomicBool,
    report: &mut Report<'_>,
    sources: &mut BTreeMap<usize, PathBuf>,
) -> Result<(), ExportError> {
    let Some((_, features)) = fitting.first() else { return Ok(()) };
    let cameras = features.videos_per_episode();
    set.begin()?;
    let positions = set.positions(fitting.iter().map(|(episode, _)| episode));
    let items: Vec<(&(Survey, Features), Position)> = fitting.iter().zip(positions).collect();
    let (folder, failed, frames) = (set.folder().to_owned(), AtomicBool::new(false), AtomicUsize::new(0));
    let prepare = |((episode, features), position): &(&(Survey, Features), Position)| {
        if stop.load(Ordering::Relaxed) {
            return Err(SetError::Refused(Refusal::Interrupted));
        }
        let ends = Ends { stop, failed: &failed };
        let encode = |ffmpeg| rapid_export::encode(&folder, episode, features, ffmpeg, ends, &frames);
        let encoded = ffmpeg.map_or_else(|| Ok(Encoded::default()), encode)?;
        let prepared = rapid_export::prepare(&folder, episode, features, *position, encoded, stop)?;
        if ffmpeg.is_none() {
            frames.fetch_add(episode.rows, Ordering::Relaxed);
        }
        Ok(prepared)
    };
    let work = Work {
        label: "exporting",
        workers: workers(jobs, cameras),
        total: fitting.iter().map(|(episode, _)| episode.rows * cameras.max(1)).sum(),
        done: Some(&frames),
    };
    work.each(&items, prepare, |((episode, features), _), prepared| {
        let appended = prepared.and_then(|prepared| set.append(episode, features, prepared, stop));
        let taken = match appended {
            Ok(number) => {
                sources.insert(number, episode.file.clone());
                report.exported(episode, features, number).map_err(ExportError::from)
            }
            Err(SetError::Refused(Refusal::Interrupted)) => Ok(()),
            Err(SetError::Refused(refusal)) => report.left_out(&episode.file, &refusal).map_err(ExportError::from),
            Err(error) => Err(error.into()),
        };
        failed.store(taken.is_err(), Ordering::Relaxed);
        taken
    })
}

fn interrupted(set: &DataSet, stop: &AtomicBool) -> Result<(), ExportError> {
    if !stop.load(Ordering::Relaxed) {
        return Ok(());
    }
    let episodes = text::counted(set.episodes() as u64, "episode");
    Err(ExportError::Interrupted { out: set.folder().to_owned(), episodes })
}

/// The files, as they were found.
struct SurveyedFiles {
    /// By number in the set.
    already: BTreeMap<usize, PathBuf>,
    new: Vec<Survey>,
}

fn found(
    files: &[PathBuf],
    args: &ExportArgs,
    set: &DataSet,
    stop: &AtomicBool,
    report: &mut Report<'_>,
) -> Result<SurveyedFiles, ExportError> {
    enum Read {
        Already(usize),
        New(Box<Survey>),
    }
    let grades: Vec<Grade> = args.verdict.iter().copied().map(VerdictArg::grade).collect();
    let verdicts = match (args.include_bad, grades.as_slice()) {
        (true, _) => Verdicts::All,
        (false, []) => Verdicts::Fit,
        (false, grades) => Verdicts::Only(grades),
    };
    let read = |file: &Path| {
        if stop.load(Ordering::Relaxed) {
            return Err(Refusal::Interrupted);
        }
        let sha256 = sha256(file)?;
        match set.find(&sha256) {
            Some(number) => Ok(Read::Already(number)),
            None => rapid_export::survey(file, sha256, verdicts, stop).map(|survey| Read::New(Box::new(survey))),
        }
    };
    let mut found = SurveyedFiles { already: BTreeMap::new(), new: Vec::new() };
    let work = Work { label: "episodes", workers: workers(args.jobs, 1), total: files.len(), done: None };
    work.each(
        files,
        |file| read(file),
        |file, read| {
            match read {
                Ok(Read::Already(number)) => {
                    report.already(file, number)?;
                    found.already.insert(number, file.clone());
                }
                Ok(Read::New(survey)) => {
                    if let Some(other) = found.new.iter().find(|other| other.sha256 == survey.sha256) {
                        let same = format!("the same as {}", other.file.display());
                        report.left_out(file, &Refusal::Different(same))?;
                    } else {
                        report.unread_registry(&survey)?;
                        found.new.push(*survey);
                    }
                }
                Err(Refusal::Interrupted) => {}
                Err(Refusal::NotSelected(_)) => report.summary.not_selected += 1,
                Err(refusal) => report.left_out(file, &refusal)?,
            }
            Ok::<_, ExportError>(())
        },
    )?;
    Ok(found)
}

/// Those that the set can have, with its features: of a new one those of the first.
fn fitting(
    episodes: Vec<Survey>,
    args: &ExportArgs,
    pictures: Pictures,
    set: &DataSet,
    report: &mut Report<'_>,
) -> Result<Vec<(Survey, Features)>, ExportError> {
    let mut known = set.features().map(Known::from_features).unwrap_or_default();
    for episode in &episodes {
        known.learn(episode);
    }
    let of_user = ExportSpec { state: args.state.clone(), action: args.action.clone() };
    let mut common = set.features().cloned();
    let mut fitting = Vec::new();
    for episode in episodes {
        let choice = match &common {
            Some(common) => of_user.or(common.choice()),
            None => of_user.or(&episode.export),
        };
        let features = Features::from_survey(&episode, &choice, pictures, &known)
            .and_then(|features| common.get_or_insert_with(|| features.clone()).check(&features).map(|()| features));
        match features {
            Ok(features) => fitting.push((episode, features)),
            Err(refusal) => report.left_out(&episode.file, &refusal)?,
        }
    }
    Ok(fitting)
}

fn verify(
    set: &DataSet,
    jobs: Option<u16>,
    sources: &BTreeMap<usize, PathBuf>,
    ffmpeg: Option<&Ffmpeg>,
    stop: &AtomicBool,
    report: &mut Report<'_>,
) -> Result<(), ExportError> {
    let files: Vec<PathBuf> = sources.values().cloned().collect();
    let numbers: BTreeMap<&Path, usize> = sources.iter().map(|(number, file)| (file.as_path(), *number)).collect();
    let number = |file: &Path| numbers.get(file).copied().unwrap_or_default();
    report.summary.verified = Some(0);
    let work = Work { label: "episodes", workers: workers(jobs, 1), total: files.len(), done: None };
    work.each(
        &files,
        |file| rapid_export::verify(set, number(file), file, ffmpeg, stop),
        |file, verified| {
            let Verified { rows, differences, psnr_db } = match verified {
                Ok(verified) => verified,
                Err(SetError::Refused(Refusal::Interrupted)) => return Ok(()),
                Err(error) => {
                    let differences = vec![Difference { frame: None, feature: None, what: error.to_string() }];
                    Verified { differences, ..Verified::default() }
                }
            };
            let worst = report.summary.psnr_db.into_iter().chain(psnr_db);
            report.summary.psnr_db = worst.min_by(f64::total_cmp);
            report.summary.verified = report.summary.verified.map(|before| before + rows);
            for difference in &differences {
                report.difference(&Differing { file, episode: number(file), difference })?;
            }
            Ok::<_, ExportError>(())
        },
    )
}

/// Writes a line for each episode, and counts.
struct Report<'a> {
    format: Format,
    out: &'a mut dyn Write,
    err: &'a mut dyn Write,
    summary: Summary<'a>,
}

impl Report<'_> {
    fn exported(&mut self, episode: &Survey, features: &Features, number: usize) -> io::Result<()> {
        self.summary.exported += 1;
        for what in features.not_exported(episode) {
            *self.summary.not_exported.entry(what).or_default() += 1;
        }
        let Survey { file, rows, unusable, unfit, grade, .. } = episode;
        self.summary.unusable += unusable;
        let mut line = format!("{}: episode {number}, {}", file.display(), text::counted(*rows as u64, "frame"));
        if !unfit.is_empty() {
            let unfit: Vec<String> = unfit.iter().map(ToString::to_string).collect();
            line = format!("{line}; samples left out, black or zero and not valid: {}", unfit.join("; "));
        }
        self.episode(
            &line,
            &Exported {
                file,
                outcome: Outcome::Exported,
                episode: Some(number),
                frames: Some(*rows),
                unusable: Some(*unusable),
                unfit,
                verdict: Some(*grade),
                reason: None,
            },
        )
    }

    /// Warns of an episode whose registry cannot be read; it is exported nevertheless.
    fn unread_registry(&mut self, episode: &Survey) -> io::Result<()> {
        let Some(reason) = &episode.unread_registry else { return Ok(()) };
        let line = format!(
            "warning: {}: the registry in it cannot be read: its [export] and the names of its numbers do not apply; \
             choose columns with --state and --action. {reason}",
            episode.file.display()
        );
        writeln!(self.err, "{}", text::plain(&line))
    }

    fn already(&mut self, file: &Path, number: usize) -> io::Result<()> {
        self.summary.already += 1;
        let line = format!("{}: episode {number} already", file.display());
        self.episode(
            &line,
            &Exported {
                file,
                outcome: Outcome::Already,
                episode: Some(number),
                frames: None,
                unusable: None,
                unfit: &[],
                verdict: None,
                reason: None,
            },
        )
    }

    fn left_out(&mut self, file: &Path, refusal: &Refusal) -> io::Result<()> {
        self.summary.left_out += 1;
        self.summary.bad += usize::from(matches!(refusal, Refusal::Bad(_)));
        if self.format == Format::Text {
            let line = format!("left out: {}: {refusal}", file.display());
            return writeln!(self.err, "{}", text::plain(&line));
        }
        let line = Exported {
            file,
            outcome: Outcome::LeftOut,
            episode: None,
            frames: None,
            unusable: None,
            unfit: &[],
            verdict: None,
            reason: Some(refusal.to_string()),
        };
        self.episode("", &line)
    }

    fn episode(&mut self, line: &str, object: &Exported<'_>) -> io::Result<()> {
        match self.format {
            Format::Json => writeln!(self.out, "{}", json_line("exported", object)?),
            Format::Text => writeln!(self.out, "{}", text::plain(line)),
        }
    }

    fn difference(&mut self, differing: &Differing<'_>) -> io::Result<()> {
        self.summary.differences += 1;
        if self.format == Format::Json {
            return writeln!(self.out, "{}", json_line("difference", differing)?);
        }
        let Difference { frame, feature, what } = differing.difference;
        let mut line = format!("different: {}: episode {}", differing.file.display(), differing.episode);
        if let Some(frame) = frame {
            line = format!("{line}, frame {frame}");
        }
        if let Some(feature) = feature {
            line = format!("{line}, {feature}");
        }
        writeln!(self.err, "{}", text::plain(&format!("{line}: {what}")))
    }

    fn end(&mut self) -> io::Result<()> {
        if self.format == Format::Json {
            return writeln!(self.out, "{}", json_line("export", &self.summary)?);
        }
        for (NotExported { name, reason }, episodes) in &self.summary.not_exported {
            let episodes = text::counted(*episodes as u64, "episode");
            writeln!(self.out, "{}", text::plain(&format!("not in the dataset: {name} of {episodes}: {reason}")))?;
        }
        let Summary { out, exported, already, left_out, bad, not_selected, unusable, .. } = &self.summary;
        let Summary { episodes, frames, verified, differences, psnr_db, .. } = &self.summary;
        let (episodes, frames) = (text::counted(*episodes as u64, "episode"), text::counted(*frames, "frame"));
        let bad = if *bad > 0 { format!(" ({bad} BAD)") } else { String::new() };
        let not_selected = if *not_selected > 0 { format!(", {not_selected} not selected") } else { String::new() };
        let mut line = format!(
            "{exported} exported, {already} already there, {left_out} left out{bad}{not_selected}; {}: {episodes}, {frames}",
            out.display()
        );
        if *unusable > 0 {
            line = format!("{line}; {} that cannot be used", text::counted(*unusable, "sample"));
        }
        if let Some(verified) = verified {
            let (verified, differences) =
                (text::counted(*verified as u64, "frame"), text::counted(*differences as u64, "difference"));
            line = format!("{line}; {verified} compared, {differences}");
        }
        if let Some(worst) = psnr_db {
            line = format!("{line}; videos within {worst:.1} dB");
        }
        writeln!(self.out, "{}", text::plain(&line))
    }
}
