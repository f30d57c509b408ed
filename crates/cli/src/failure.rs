//! Unsuccessful ends of a command.

use std::fmt;
use std::process::ExitCode;

use splat_data::text::one_line;

use super::interrupt;

/// Why a command failed. `Display` is the one line for the user.
#[derive(Debug)]
pub enum Failure {
    /// The user's input is unusable: exit status 2.
    BadInput(String),
    /// A check ran and failed: exit status 1.
    Check(String),
    /// Ctrl-C came before there was anything to save: exit status 130, as of a program that it ends
    /// at once.
    Interrupted(String),
}

impl Failure {
    /// The process's exit status.
    pub fn exit_code(&self) -> ExitCode {
        match self {
            Self::Check(_) => ExitCode::from(1),
            Self::BadInput(_) => ExitCode::from(2),
            Self::Interrupted(_) => ExitCode::from(interrupt::STATUS),
        }
    }

    /// The line without the kind of failure.
    pub(super) fn reason(self) -> String {
        match self {
            Self::BadInput(reason) | Self::Check(reason) | Self::Interrupted(reason) => reason,
        }
    }
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::BadInput(reason) => write!(f, "error: {reason}"),
            Self::Check(reason) => write!(f, "failed: {reason}"),
            Self::Interrupted(reason) => write!(f, "stopped: {reason}"),
        }
    }
}

/// Errors of the libraries concern their input and name it.
impl<E: std::error::Error> From<E> for Failure {
    fn from(error: E) -> Self {
        Self::BadInput(one_line(&error.to_string()))
    }
}
