//! The grammar of `rapid list`.

use std::path::PathBuf;

use clap::{Args, ValueEnum, ValueHint};
use rapid_core::time::Zone;
use rapid_status::Grade;
use rapid_status::session::Label;

pub(super) const LIST: &str = "\
Every file is read completely and judged again, and the labels and notes of its session are shown beside it. \
Several verdicts or labels are alternatives; all other options must match. A file that cannot be read is always listed.

Examples:
  rapid list
  rapid list --verdict good --label success --task place
  rapid list --without tactile_tip --since 2026-11-24
  rapid list /data/monday /data/tuesday --tag finger=soft --sort length
  rapid list --verdict good --label success --json | jq -r 'select(.verdict).file' > training.txt";

/// Which episodes, and how.
#[derive(Debug, Args)]
pub struct ListArgs {
    /// Episodes, or folders of them
    #[arg(value_name = "FILE|DIR", default_value = "episodes", value_hint = ValueHint::AnyPath)]
    pub paths: Vec<PathBuf>,
    /// Only those with this verdict; repeatable, or separated by commas
    #[arg(long, value_name = "VERDICT", value_delimiter = ',', ignore_case = true)]
    pub verdict: Vec<VerdictArg>,
    /// Only those with this label; repeatable, or separated by commas
    #[arg(long, value_name = "LABEL", value_delimiter = ',')]
    pub label: Vec<LabelFilter>,
    /// Only those whose task contains this, in any case
    #[arg(long, value_name = "TEXT")]
    pub task: Option<String>,
    /// Only those with this tag; repeatable
    #[arg(long, value_name = "KEY=VALUE", value_parser = super::tag)]
    pub tag: Vec<(String, String)>,
    /// Only those with samples of this sensor; repeatable, all required
    #[arg(long, value_name = "NAME")]
    pub sensor: Vec<String>,
    /// Only those without any sample of this sensor; repeatable, all excluded
    #[arg(long, value_name = "NAME")]
    pub without: Vec<String>,
    /// Only those begun at this date or later: 2026-11-24, 2026-11-24T13:30
    #[arg(long, value_name = "DATE")]
    pub since: Option<String>,
    /// Only those begun before this date
    #[arg(long, value_name = "DATE")]
    pub before: Option<String>,
    /// Order of the lines
    #[arg(long, value_name = "ORDER", default_value = "begin")]
    pub sort: SortArg,
    /// Times in UTC instead of the zone of this machine
    #[arg(long)]
    pub utc: bool,
}

impl ListArgs {
    /// The zone of its dates.
    pub fn zone(&self) -> Zone {
        if self.utc { Zone::UTC } else { Zone::local() }
    }
}

/// A verdict.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum VerdictArg {
    /// Nothing is wrong.
    Good,
    /// Something is doubtful.
    Suspect,
    /// Not fit for use.
    Bad,
}

impl VerdictArg {
    /// The verdict meant.
    pub const fn grade(self) -> Grade {
        match self {
            Self::Good => Grade::Good,
            Self::Suspect => Grade::Suspect,
            Self::Bad => Grade::Bad,
        }
    }
}

/// A label, or none.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum LabelFilter {
    /// The demonstration succeeded.
    Success,
    /// It failed.
    Failure,
    /// No label was given.
    None,
}

impl LabelFilter {
    /// The label.
    pub const fn label(self) -> Option<Label> {
        match self {
            Self::Success => Some(Label::Success),
            Self::Failure => Some(Label::Failure),
            Self::None => None,
        }
    }

    /// The word for what an episode has.
    pub const fn of(label: Option<Label>) -> Self {
        match label {
            Some(Label::Success) => Self::Success,
            Some(Label::Failure) => Self::Failure,
            None => Self::None,
        }
    }
}

/// By what the lines are sorted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum SortArg {
    /// When they began, oldest first.
    Begin,
    /// The worst first.
    Verdict,
    /// The longest first.
    Length,
    /// The largest first.
    Size,
    /// By name.
    Name,
}
