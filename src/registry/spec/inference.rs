//! `[inference]`: what policies are computed on, on this machine.

/// `[inference]`: the defaults of `--threads` and `--provider`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct InferenceSpec {
    /// Threads that onnxruntime computes on, `1..=64`, default 1: the rig's other tasks need the processor too.
    pub threads: usize,
    /// Which of onnxruntime's execution providers computes, default `cpu`.
    pub provider: Provider,
}

impl InferenceSpec {
    /// Most threads.
    pub const MOST_THREADS: usize = 64;
}

impl Default for InferenceSpec {
    fn default() -> Self {
        Self { threads: 1, provider: Provider::Cpu }
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
