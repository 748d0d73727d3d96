//! The output directory. It is checked before the command runs, and files of an earlier run are
//! replaced.

use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result};

use super::super::UserError;

const JUNIT_FILE: &str = "junit.xml";
const REPORT_FILE: &str = "report.html";
const LOG_FILE: &str = "agent.log";
const BAG_NAME: &str = "bag";

/// The directory.
pub(super) struct Artefacts {
    directory: PathBuf,
}

impl Artefacts {
    /// Creates the directory, checks that files can be written to it, and removes the files of an
    /// earlier run.
    ///
    /// # Errors
    ///
    /// Fails if the directory cannot be written, or if `bag/` has files that are not of a bag.
    pub(super) fn create(directory: &Path) -> Result<Self> {
        let unwritable = || {
            format!(
                "cannot write to the output directory {}",
                directory.display()
            )
        };
        fs::create_dir_all(directory).with_context(unwritable)?;
        let artefacts = Self {
            directory: directory.to_path_buf(),
        };
        for name in [JUNIT_FILE, REPORT_FILE, LOG_FILE] {
            fs::write(directory.join(name), "").with_context(unwritable)?;
            fs::remove_file(directory.join(name)).with_context(unwritable)?;
        }
        artefacts.remove_bag()?;
        Ok(artefacts)
    }

    /// Returns the path of the agent's log.
    pub(super) fn log(&self) -> PathBuf {
        self.directory.join(LOG_FILE)
    }

    /// Copies the bag in `recording`, if there is one. Returns `content` with the place of the bag.
    ///
    /// # Errors
    ///
    /// Fails if a file cannot be copied. The copy is then removed, because the reports need space.
    pub(super) fn keep_bag(&self, recording: &Path, content: String) -> Result<String> {
        if !recording.is_dir() {
            return Ok(content);
        }
        let bag = self.directory.join(BAG_NAME);
        let unwritable = || format!("cannot write {}", bag.display());
        fs::create_dir(&bag).with_context(unwritable)?;
        if let Err(error) = copy_files(recording, &bag) {
            let _ = self.remove_bag();
            return Err(error).with_context(unwritable);
        }
        Ok(format!("{BAG_NAME}/: {content}"))
    }

    /// Writes the reports.
    pub(super) fn write(&self, junit: &[u8], report: &str) -> Result<()> {
        for (name, content) in [(JUNIT_FILE, junit), (REPORT_FILE, report.as_bytes())] {
            let path = self.directory.join(name);
            fs::write(&path, content)
                .with_context(|| format!("cannot write {}", path.display()))?;
        }
        Ok(())
    }

    /// Removes the bag of an earlier run, and nothing else.
    fn remove_bag(&self) -> Result<()> {
        let bag = self.directory.join(BAG_NAME);
        let remove = || -> io::Result<bool> {
            if !bag.exists() {
                return Ok(true);
            }
            let files = fs::read_dir(&bag)?.collect::<io::Result<Vec<_>>>()?;
            let is_of_bag = |file: &fs::DirEntry| {
                let name = file.file_name();
                name == "metadata.yaml"
                    || Path::new(&name).extension().is_some_and(|it| it == "mcap")
            };
            if !files.iter().all(is_of_bag) {
                return Ok(false);
            }
            for file in files {
                fs::remove_file(file.path())?;
            }
            fs::remove_dir(&bag)?;
            Ok(true)
        };
        let path = bag.display();
        match remove().with_context(|| format!("cannot replace {path}"))? {
            true => Ok(()),
            false => {
                let text =
                    format!("rp: {path} has files that are not of a bag: choose another --output");
                Err(UserError(text).into())
            }
        }
    }
}

fn copy_files(from: &Path, to: &Path) -> io::Result<()> {
    for file in fs::read_dir(from)? {
        let file = file?;
        // The permissions are those of the other files, not those of the agent.
        let mut copy = File::create_new(to.join(file.file_name()))?;
        io::copy(&mut File::open(file.path())?, &mut copy)?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bag_that_cannot_be_copied_leaves_no_files() {
        let root = tempfile::tempdir().unwrap();
        let (output, recording) = (root.path().join("output"), root.path().join("recording"));
        let artefacts = Artefacts::create(&output).unwrap();
        fs::create_dir(&recording).unwrap();
        fs::write(recording.join("bag_0.mcap"), "messages").unwrap();
        let kept = || artefacts.keep_bag(&recording, "1 message".to_owned());
        assert_eq!(kept().unwrap(), "bag/: 1 message");
        artefacts.remove_bag().unwrap();
        // Reading a directory fails after its copy was created.
        fs::create_dir(recording.join("bag_1.mcap")).unwrap();
        assert!(kept().is_err());
        assert!(!output.join(BAG_NAME).exists());
    }
}
