//! The grammar of `rapid export`.

use std::path::PathBuf;

use clap::{Args, ValueEnum, ValueHint};

use super::list::{LabelFilter, VerdictArg};

pub(super) const EXPORT: &str = "\
A row is a tick of the frame index (/rapid/frame), with the sample of each sensor that belongs to it: pictures as \
observation.images.NAME, JPEGs byte for byte and others as PNG, or with --pictures av1 as a video; numbers as observation.state; /action as action; and \
rapid.mask, rapid.plugged, rapid.valid, rapid.age, rapid.time_ns. What is absent is black or zero, with its mask.

Episodes that DIR has already are skipped, new ones are appended. An episode that does not fit is left out and named; so \
is one that is BAD. --label and --verdict select as those of `rapid list` do; label and note of each episode are in \
meta/episodes. Interrupted, DIR has the episodes so far, and the same command continues.

Examples:
  rapid export episodes --to lerobot --out place-block
  rapid export episodes --to lerobot --out place-block --verify
  rapid export episodes --to lerobot --out small --pictures av1
  rapid export monday tuesday/*.mcap --to lerobot --out both --state motor_state,force
  rapid export episodes --to lerobot --out own --state arm.position,phone --action phone,grip.0
  rapid export episodes --to lerobot --out good --label success --verdict good

Exit code: 0 if DIR has at least one of the episodes, otherwise 1; 1 also if --verify finds a difference or it is \
interrupted.";

/// Which episodes, and where to.
#[derive(Debug, Clone, Args)]
pub struct ExportArgs {
    /// Episodes, or folders of them
    #[arg(required = true, value_name = "FILE|DIR", value_hint = ValueHint::AnyPath)]
    pub paths: Vec<PathBuf>,
    /// Format of the dataset: lerobot (v3.0)
    #[arg(long, value_name = "FORMAT", hide_possible_values = true)]
    pub to: Layout,
    /// Folder of the dataset: a new one, or one to append to
    #[arg(long, value_name = "DIR", value_hint = ValueHint::DirPath)]
    pub out: PathBuf,
    /// Only those with this verdict, also bad; repeatable, or separated by commas [default: good,suspect]
    #[arg(long, value_name = "VERDICT", value_delimiter = ',', ignore_case = true)]
    pub verdict: Vec<VerdictArg>,
    /// Only those with this label; repeatable, or separated by commas
    #[arg(long, value_name = "LABEL", value_delimiter = ',')]
    pub label: Vec<LabelFilter>,
    /// Also those that are BAD
    #[arg(long, conflicts_with = "verdict")]
    pub include_bad: bool,
    /// Numbers of observation.state: NAME, NAME.0, NAME.0-5, NAME.position [default: as in DIR, else as in the episode's
    /// registry, else all]
    #[arg(long, value_name = "COLUMNS", value_delimiter = ',')]
    pub state: Vec<String>,
    /// Numbers of action, of the same tick, likewise; /action is that topic [default: as in DIR, else as in the episode's
    /// registry, else /action]
    #[arg(long, value_name = "COLUMNS", value_delimiter = ',')]
    pub action: Vec<String>,
    /// Pictures as the camera's own JPEGs, or as videos that ffmpeg encodes: jpeg, av1 or h264 [default: jpeg; or as in DIR]
    #[arg(long, value_name = "FORM", hide_possible_values = true)]
    pub pictures: Option<PictureForm>,
    /// Program that encodes and decodes videos [default: ffmpeg on the PATH]
    #[arg(long, value_name = "PROGRAM", value_hint = ValueHint::ExecutablePath)]
    pub ffmpeg: Option<PathBuf>,
    /// Episodes worked on at a time; the result is the same [default: as many as keep the processors busy]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    pub jobs: Option<u16>,
    /// Read DIR back and compare it with the episodes, bit for bit; frames of a video within what an encoder loses
    #[arg(long)]
    pub verify: bool,
}

/// A format of datasets.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Layout {
    /// LeRobot v3.0.
    Lerobot,
}

/// How a dataset has its pictures.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum PictureForm {
    /// Each as it is, JPEG or PNG.
    Jpeg,
    /// Videos in AV1.
    Av1,
    /// Videos in H.264.
    H264,
}
