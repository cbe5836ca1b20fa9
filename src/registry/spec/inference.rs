//! `[inference]`: what policies are computed on, on this machine.

use crate::keys::{Words, keys, whole};
use crate::section::of_nothing;

keys! {
    /// `[inference]`: the defaults of `--threads` and `--provider`.
    #[derive(Debug, Clone, Copy, PartialEq, Eq)]
    pub struct InferenceSpec {
        /// Threads that onnxruntime computes on; the rig's other tasks need the processor too.
        threads: usize = whole::<usize>(1, 64), or 1;
        /// Which of onnxruntime's execution providers computes.
        provider: Provider = Words(&Provider::WORDS), or Provider::Cpu;
    }
}

impl InferenceSpec {
    /// Most threads.
    pub const MOST_THREADS: usize = 64;
}

impl Default for InferenceSpec {
    fn default() -> Self {
        of_nothing(Self::values)
    }
}

/// An execution provider of onnxruntime (<https://onnxruntime.ai/docs/execution-providers>).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Provider {
    /// The processor.
    Cpu,
    /// A GPU of NVIDIA, by CUDA.
    Cuda,
    /// The same, by `TensorRT`, and by CUDA for what that does not compute.
    TensorRt,
}

impl Provider {
    /// Their words in `devices.toml` and on the command line.
    pub const WORDS: [(&str, Self); 3] = [("cpu", Self::Cpu), ("cuda", Self::Cuda), ("tensorrt", Self::TensorRt)];

    /// Its word.
    pub const fn word(self) -> &'static str {
        match self {
            Self::Cpu => "cpu",
            Self::Cuda => "cuda",
            Self::TensorRt => "tensorrt",
        }
    }
}
