//! The grammar of `rapid episode` and `rapid session`.

use clap::{Subcommand, ValueEnum};
use rapid_status::session::{Label, SessionRequest};

pub(super) const EPISODE: &str = "\
The running rapid answers when it is done and on the disk: `stop` when the file is closed,
`start`, `next` and `redo` when the episode has begun.

Examples:
  rapid episode start
  rapid episode stop && rapid episode label success
  rapid episode label failure \"the block slipped\"
  rapid episode mark grasped
  rapid episode discard                  to the trash; `rapid episode undo` takes it back";

pub(super) const SESSION: &str = "\
Without a command, prints what has been collected.

Examples:
  rapid session
  rapid session plan --task \"place block\" --tag finger=soft --goal 50
  rapid session --json | jq .counted
  rapid session end                      closes its file and deletes what was discarded";

/// What to do with an episode.
#[derive(Debug, Subcommand)]
pub enum EpisodeCommand {
    /// Begin an episode; during a countdown or a reset, at once
    #[command(after_long_help = "Examples:\n  rapid episode start --instance left")]
    Start,
    /// End the episode; no other begins by itself
    #[command(after_long_help = "Examples:\n  rapid episode stop && rapid episode label success")]
    Stop,
    /// End the episode and begin the next
    #[command(after_long_help = "Examples:\n  rapid episode next")]
    Next,
    /// Discard the episode, or the last one, and record it again
    #[command(after_long_help = "Examples:\n  rapid episode redo")]
    Redo,
    /// Move the episode, or the last one, to the trash
    #[command(
        after_long_help = "Examples:\n  rapid episode discard\n  rapid episode discard 20261125_episode_003.mcap"
    )]
    Discard {
        /// Name of an episode of this session
        #[arg(value_name = "FILE", value_parser = file_name)]
        episode: Option<String>,
    },
    /// Take the last discarded episode back from the trash
    #[command(after_long_help = "Examples:\n  rapid episode undo")]
    Undo,
    /// Mark this moment of the episode
    #[command(after_long_help = "Examples:\n  rapid episode mark grasped")]
    Mark {
        /// What the moment is
        #[arg(value_name = "TEXT", default_value = "")]
        text: String,
    },
    /// Label the episode, or the last one
    #[command(
        after_long_help = "Examples:\n  rapid episode label success\n  rapid episode label failure \"the block slipped\""
    )]
    Label {
        /// Whether the demonstration succeeded
        label: LabelArg,
        /// Why
        #[arg(value_name = "TEXT", default_value = "")]
        reason: String,
        /// Another episode of this session, by its name
        #[arg(long, value_name = "FILE", value_parser = file_name)]
        episode: Option<String>,
    },
    /// Attach a note to the episode, or to the last one
    #[command(
        after_long_help = "Examples:\n  rapid episode note \"new gripper pads\"\n  rapid episode note \"\"             removes it"
    )]
    Note {
        /// The note; an empty one removes it
        #[arg(value_name = "TEXT")]
        text: String,
        /// Another episode of this session, by its name
        #[arg(long, value_name = "FILE", value_parser = file_name)]
        episode: Option<String>,
    },
}

/// A label on the command line.
#[derive(Debug, Clone, Copy, ValueEnum)]
pub enum LabelArg {
    /// It succeeded
    Success,
    /// It failed
    Failure,
}

impl EpisodeCommand {
    /// The request to the session.
    pub fn into_request(self) -> SessionRequest {
        match self {
            Self::Start => SessionRequest::Start,
            Self::Stop => SessionRequest::Stop,
            Self::Next => SessionRequest::Next,
            Self::Redo => SessionRequest::Redo,
            Self::Discard { episode } => SessionRequest::Discard { episode },
            Self::Undo => SessionRequest::Undo,
            Self::Mark { text } => SessionRequest::Mark { text },
            Self::Label { label, reason, episode } => {
                let label = match label {
                    LabelArg::Success => Label::Success,
                    LabelArg::Failure => Label::Failure,
                };
                SessionRequest::Label { episode, label, reason }
            }
            Self::Note { text, episode } => SessionRequest::Note { episode, text },
        }
    }
}

/// What to do with the session.
#[derive(Debug, Subcommand)]
pub enum SessionCommand {
    /// Change task, tags, goal or modules of the next episodes
    #[command(
        after_long_help = "Examples:\n  rapid session plan --task \"place block\" --tag finger=soft --goal 50\n  rapid session plan --tag finger=\n  rapid session plan --module tip_soft"
    )]
    Plan {
        /// Task, part of the file's name
        #[arg(long, value_name = "TEXT")]
        task: Option<String>,
        /// Property of the episodes, such as finger=soft; without a value it is removed; repeatable
        #[arg(long, value_name = "KEY=VALUE", value_parser = change_of_tag)]
        tag: Vec<(String, String)>,
        /// Episodes wanted; 0 removes the goal
        #[arg(long, value_name = "COUNT")]
        goal: Option<u32>,
        /// Module that is mounted now, in place of the one in its slot; none: no declared one; repeatable
        #[arg(long, value_name = "NAME")]
        module: Vec<String>,
    },
    /// End the session: close its file and delete what was discarded
    #[command(after_long_help = "Examples:\n  rapid session end")]
    End,
}

impl SessionCommand {
    /// The request to the session.
    pub fn into_request(self) -> SessionRequest {
        match self {
            Self::Plan { task, tag, goal, module } => SessionRequest::Plan { task, tags: tag, goal, modules: module },
            Self::End => SessionRequest::EndSession,
        }
    }
}

/// The name of a file; of a path, its last part, as a shell completes it.
#[expect(clippy::unnecessary_wraps, reason = "as clap calls it")]
fn file_name(text: &str) -> Result<String, String> {
    let name = std::path::Path::new(text).file_name();
    Ok(name.map_or_else(|| text.to_owned(), |name| name.to_string_lossy().into_owned()))
}

/// A tag to set, or to remove.
fn change_of_tag(text: &str) -> Result<(String, String), String> {
    match text.strip_suffix('=') {
        Some(key) if !key.is_empty() => Ok((key.to_owned(), String::new())),
        _ => super::tag(text),
    }
}
