//! Commands printed for the user to type, quoted for a POSIX shell.

use std::path::Path;

use super::GlobalArgs;
use super::photos::PhotoArgs;

/// A command of this program, built argument by argument.
#[derive(Debug, Clone)]
pub(super) struct CommandLine(String);

impl CommandLine {
    /// `splat COMMAND`, on the same device.
    pub(super) fn new(command: &str, global: &GlobalArgs) -> Self {
        let device = match global.device {
            super::DeviceChoice::Auto => String::new(),
            chosen => format!(" --device {}", chosen.argument()),
        };
        Self(format!("splat {command}{device}"))
    }

    /// Adds a path.
    pub(super) fn path(mut self, path: &Path) -> Self {
        self.0 += &format!(" {}", quoted(path));
        self
    }

    /// Adds an option with a path.
    pub(super) fn option(mut self, name: &str, path: &Path) -> Self {
        self.0 += &format!(" {name}");
        self.path(path)
    }

    /// Adds the options for reading photos that were given.
    pub(super) fn photos(self, photos: &PhotoArgs) -> Self {
        let words = photos.words();
        words.chunks_exact(2).fold(self, |line, pair| {
            line.option(&pair[0].to_string_lossy(), Path::new(&pair[1]))
        })
    }

    /// Adds an option without a value.
    pub(super) fn flag(mut self, name: &str) -> Self {
        self.0 += &format!(" {name}");
        self
    }

    /// The command in one line; `None` if a path contains line breaks or other control characters.
    pub(super) fn in_a_line(&self) -> Option<&str> {
        (!self.0.contains(char::is_control)).then_some(&self.0)
    }
}

impl std::fmt::Display for CommandLine {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.0)
    }
}

/// A path as one word, which cannot be mistaken for an option.
pub(super) fn quoted(path: &Path) -> String {
    let text = path.to_string_lossy();
    let text = match text.starts_with('-') {
        true => format!("./{text}"),
        false => text.into_owned(),
    };
    match shlex::try_quote(&text) {
        Ok(quoted) => quoted.into_owned(),
        // Contains NUL, which no path does.
        Err(_) => text,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The shell parses the words back to the originals.
    #[test]
    #[cfg(unix)]
    fn a_shell_gives_the_paths_back() {
        let paths = [
            "plain/path",
            "with blank",
            "it's \"quoted\"",
            "$HOME `date` \\ * ? [a] {b,c} ! ^ # ~",
            "~",
            "-dash",
            "--",
            "a\nb",
            "ü",
        ];
        let global = GlobalArgs {
            device: super::super::DeviceChoice::Cpu,
            seed: None,
            quiet: false,
        };
        let mut line = CommandLine::new("train", &global);
        for path in paths {
            line = line.option("--out", path.as_ref());
        }
        assert_eq!(line.in_a_line(), None);
        let script = format!("splat() {{ printf '%s\\0' \"$@\"; }}; {line}");
        let output = std::process::Command::new("sh")
            .args(["-c", &script])
            .output()
            .unwrap();
        let words = String::from_utf8(output.stdout).unwrap();
        let words: Vec<&str> = words.trim_end_matches('\0').split('\0').collect();
        assert_eq!(words[..3], ["train", "--device", "cpu"]);
        let given = paths.map(|path| match path.starts_with('-') {
            true => format!("./{path}"),
            false => path.to_owned(),
        });
        for (word, path) in words[3..].chunks(2).zip(given) {
            assert_eq!(word, ["--out", &path]);
        }
    }
}
