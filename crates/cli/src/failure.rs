//! How a command ends when it does not succeed.

use std::fmt;
use std::process::ExitCode;

use splat_data::text::one_line;

/// Why a command did not succeed. `Display` is the one line for the user.
#[derive(Debug)]
pub enum Failure {
    /// What the user gave cannot be used: exit status 2.
    BadInput(String),
    /// A check ran and found something: exit status 1.
    Check(String),
}

impl Failure {
    /// The process's exit status.
    pub fn exit_code(&self) -> ExitCode {
        match self {
            Self::Check(_) => ExitCode::from(1),
            Self::BadInput(_) => ExitCode::from(2),
        }
    }

    /// The line without what kind of failure it is.
    pub(super) fn reason(self) -> String {
        match self {
            Self::BadInput(reason) | Self::Check(reason) => reason,
        }
    }
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::BadInput(reason) => write!(f, "error: {reason}"),
            Self::Check(reason) => write!(f, "failed: {reason}"),
        }
    }
}

/// The libraries' errors are about what they were given, and name it.
impl<E: std::error::Error> From<E> for Failure {
    fn from(error: E) -> Self {
        Self::BadInput(one_line(&error.to_string()))
    }
}
