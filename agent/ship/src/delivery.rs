//! The delivery of one bag: checksums, files in parts, manifest. Each step is recorded, so that a
//! killed process continues with the next one.

use std::fs::File;
use std::io::{self, Read as _, Seek as _, SeekFrom};
use std::path::{Path as FilePath, PathBuf};

use bytes::Bytes;
use object_store::path::Path;
use sha2::{Digest as _, Sha256};
use tokio::task::{spawn_blocking, yield_now};

use crate::bags::{Bag, Fingerprint};
use crate::manifest::{self, Manifest};
use crate::shipper::Shipper;
use crate::state::{Delivery, Destination, FileDelivery, Upload};
use crate::store::{Store, StoreError};

/// Size of a part in bytes. A smaller file is sent at once.
const PART_BYTES: u64 = 8 << 20;
/// Maximum number of parts of a file. Parts of a larger file are larger: stores accept 10,000.
const MAX_PARTS: u64 = 9_000;
/// Bytes that are read at once for a checksum.
const READ_BYTES: usize = 256 << 10;
/// Maximum number of bags of one name at the destination.
const MAX_NAMESAKES: u32 = 1_000;

/// Result of an attempt to deliver a bag.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Step {
    /// The destination has the bag.
    Delivered,
    /// Another bag is more urgent, or the window closed.
    Interrupted,
}

/// What a step of one file did.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Sent {
    /// The destination has more of it than before.
    Done,
    /// A triggered bag waits. The file begins again later.
    Interrupted,
}

/// A checksum of a file that is continued after an interruption.
pub(crate) struct PartialChecksum {
    path: PathBuf,
    /// State of the bag to which the file belongs.
    fingerprint: Fingerprint,
    digest: Sha256,
    /// Bytes that were read.
    bytes: u64,
}

/// Why a delivery failed.
#[derive(Debug, thiserror::Error)]
pub(crate) enum DeliveryError {
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The destination cannot be opened, or its credentials cannot be used.
    #[error(transparent)]
    Settings(#[from] crate::settings::SettingsError),
    #[error("cannot read {}", .0.display())]
    Read(PathBuf, #[source] io::Error),
    #[error("the bag changed during its delivery")]
    Changed,
    #[error("the destination has too many bags of this name")]
    Namesakes,
}

impl DeliveryError {
    /// Returns whether the failure concerns this bag, and not the link or the store.
    pub(crate) fn is_of_bag(&self) -> bool {
        match self {
            Self::Store(StoreError::Refused { status, .. }) => {
                let general = [401, 403, 407, 408, 429];
                status.is_client_error() && !general.contains(&status.as_u16())
            }
            Self::Store(StoreError::Missing(_)) => true,
            Self::Store(StoreError::Unreachable(_) | StoreError::Unusable(_))
            | Self::Settings(_) => false,
            Self::Read(..) | Self::Changed | Self::Namesakes => true,
        }
    }
}

impl Shipper {
    /// Delivers a bag as far as possible.
    pub(crate) async fn deliver(&mut self, bag: &Bag) -> Result<Step, DeliveryError> {
        let mut delivery = self.recorded(bag).await?;
        for index in 0..delivery.files.len() {
            let file = delivery.files.get(index);
            let Some(file) = file.filter(|file| file.sha256.is_none()) else {
                continue;
            };
            let (name, bytes) = (file.name.clone(), file.bytes);
            let Some(sha256) = self.checksum(bag, &name, bytes).await? else {
                return Ok(Step::Interrupted);
            };
            if let Some(file) = delivery.files.get_mut(index) {
                file.sha256 = Some(sha256);
            }
            self.records.keep(&bag.name, delivery.clone());
        }
        if delivery.remote.is_none() && self.choose_name(bag, &mut delivery).await? {
            return self.finish(bag, delivery);
        }
        // All sizes are compared at the end: the destination may lose files during a long delivery.
        let goals: [fn(&FileDelivery) -> bool; 2] = [|file| file.is_sent, |file| file.is_delivered];
        for is_reached in goals {
            for index in 0..delivery.files.len() {
                while delivery
                    .files
                    .get(index)
                    .is_some_and(|file| !is_reached(file))
                {
                    let mut is_interrupted = self.is_interrupted(bag);
                    if !is_interrupted {
                        self.store()?.reload_credentials()?;
                        let sent = self.send(bag, &mut delivery, index).await;
                        self.records.keep(&bag.name, delivery.clone());
                        is_interrupted = sent? == Sent::Interrupted;
                    }
                    if is_interrupted {
                        delivery.forget_sizes();
                        self.records.keep(&bag.name, delivery);
                        return Ok(Step::Interrupted);
                    }
                    self.show_progress(bag, &delivery);
                }
            }
        }
        if Fingerprint::of(&bag.path).ok().as_ref() != Some(&bag.fingerprint) {
            return Err(DeliveryError::Changed);
        }
        let text = match &delivery.manifest {
            Some(text) => text.clone(),
            None => {
                let findings = self.findings_of(bag).await;
                let manifest = Manifest::new(&self.settings.instance, bag, &delivery, findings);
                let text = serde_json::to_string_pretty(&manifest).unwrap_or_default() + "\n";
                delivery.manifest = Some(text.clone());
                self.records.keep(&bag.name, delivery.clone());
                text
            }
        };
        let path = self.path(&delivery, manifest::FILE_NAME);
        self.store()?.put(&path, text.into()).await?;
        self.finish(bag, delivery)
    }

    /// Returns the record of a bag, or a new one. A record of another bag of this name, or of
    /// another destination, is dropped.
    async fn recorded(&mut self, bag: &Bag) -> Result<Delivery, DeliveryError> {
        if let Some(delivery) = self.records.get(&bag.name) {
            if delivery.fingerprint == bag.fingerprint && delivery.destination == self.destination()
            {
                return Ok(delivery.clone());
            }
            self.drop_record(&bag.name).await?;
        }
        let files = bag.fingerprint.files().into_iter();
        let files = files.map(|(name, bytes)| FileDelivery {
            name: name.to_owned(),
            bytes,
            ..FileDelivery::default()
        });
        Ok(Delivery {
            destination: self.destination(),
            fingerprint: bag.fingerprint.clone(),
            is_complete: bag.content.is_complete,
            files: files.collect(),
            ..Delivery::default()
        })
    }

    /// Forgets a bag, and ends its unfinished uploads at the destination.
    pub(crate) async fn drop_record(&mut self, name: &str) -> Result<(), DeliveryError> {
        let Some(delivery) = self.records.forget(name) else {
            return Ok(());
        };
        // The uploads of another destination are unknown to this one.
        if delivery.destination != self.destination() {
            return Ok(());
        }
        for file in delivery.files.iter().filter(|file| !file.is_delivered) {
            if let Some(upload) = &file.upload {
                let path = self.path(&delivery, &file.name);
                self.store()?.abort(&path, &upload.id).await;
            }
        }
        Ok(())
    }

    /// Chooses the name of a bag at the destination: its own, or with a number if another bag has
    /// that. Returns whether the destination has this bag already, as after a loss of the records.
    async fn choose_name(
        &mut self,
        bag: &Bag,
        delivery: &mut Delivery,
    ) -> Result<bool, DeliveryError> {
        for number in 1..=MAX_NAMESAKES {
            let name = match number {
                1 => bag.name.clone(),
                _ => format!("{}-{number}", bag.name),
            };
            // The name of another bag on this robot is left to that bag.
            let is_other = number > 1 && self.settings.recordings.join(&name).exists();
            if is_other || self.is_reserved(bag, &name) {
                continue;
            }
            delivery.remote = Some(name);
            let path = self.path(delivery, manifest::FILE_NAME);
            let text = self.store()?.get(&path).await.inspect_err(|_| {
                delivery.remote = None;
            })?;
            let Some(text) = text else {
                self.records.keep(&bag.name, delivery.clone());
                return Ok(false);
            };
            let other = serde_json::from_slice::<Manifest>(&text).ok();
            let is_same = other.is_some_and(|other| other.files == manifest::files(delivery));
            if is_same {
                delivery.manifest = String::from_utf8(text.to_vec()).ok();
                return Ok(true);
            }
        }
        delivery.remote = None;
        Err(DeliveryError::Namesakes)
    }

    /// Returns whether the delivery of another bag uses this name.
    fn is_reserved(&self, bag: &Bag, name: &str) -> bool {
        let others = self.records.names().filter(|other| *other != bag.name);
        let mut others = others.filter_map(|other| self.records.get(other));
        others.any(|other| other.remote.as_deref() == Some(name))
    }

    /// Sends the next part of a file, or compares its size once all of it is sent.
    async fn send(
        &mut self,
        bag: &Bag,
        delivery: &mut Delivery,
        index: usize,
    ) -> Result<Sent, DeliveryError> {
        let Some(name) = delivery.files.get(index).map(|file| file.name.clone()) else {
            return Ok(Sent::Done);
        };
        let path = self.path(delivery, &name);
        let source = bag.path.join(&name);
        let store = self.store()?;
        let Some(file) = delivery.files.get_mut(index) else {
            return Ok(Sent::Done);
        };
        if file.is_sent {
            // Each response is recorded, so that a delivery over a poor link also completes.
            file.is_delivered = store.size(&path).await? == Some(file.bytes);
            file.is_sent = file.is_delivered;
            file.upload = None;
            return match file.is_delivered {
                true => Ok(Sent::Done),
                false => Err(StoreError::Missing(None).into()),
            };
        }
        if !store.is_resumable() {
            let sent = self.copy(bag, &path, &source, file.bytes).await?;
            file.is_sent = sent == Sent::Done;
            return Ok(sent);
        }
        if file.bytes > PART_BYTES {
            send_part(store, &path, &source, file).await?;
        } else {
            let content = read_part(&source, 0, file.bytes)?;
            store.put(&path, content).await?;
            file.is_sent = true;
        }
        Ok(Sent::Done)
    }

    /// Copies a file into a folder, unless a triggered bag waits.
    async fn copy(
        &mut self,
        bag: &Bag,
        path: &Path,
        source: &FilePath,
        bytes: u64,
    ) -> Result<Sent, DeliveryError> {
        let mut target = self.store()?.begin_file(path).await?;
        let mut begin = 0;
        while begin < bytes {
            // The end of a window does not interrupt it, because the file would begin again.
            if begin > 0 && self.is_overtaken(bag) {
                target.abort().await;
                return Ok(Sent::Interrupted);
            }
            let length = PART_BYTES.min(bytes - begin);
            let written = match read_part(source, begin, length) {
                Ok(content) => target.write(content).await.map_err(DeliveryError::from),
                Err(error) => Err(error),
            };
            if let Err(error) = written {
                target.abort().await;
                return Err(error);
            }
            begin += length;
        }
        target.complete().await?;
        Ok(Sent::Done)
    }

    /// Returns the SHA-256 of a file of a bag, in hexadecimal digits; `None` if the delivery is
    /// interrupted. The next call continues.
    async fn checksum(
        &mut self,
        bag: &Bag,
        name: &str,
        bytes: u64,
    ) -> Result<Option<String>, DeliveryError> {
        let path = bag.path.join(name);
        let is_of_file =
            |kept: &mut PartialChecksum| kept.path == path && kept.fingerprint == bag.fingerprint;
        let kept = self.partial_checksum.take_if(is_of_file);
        let begin = || PartialChecksum::new(path.clone(), bag.fingerprint.clone());
        let mut checksum = kept.unwrap_or_else(begin);
        let mut file = checksum.open()?;
        let mut buffer = vec![0; READ_BYTES];
        while checksum.read(&mut file, &mut buffer)? {
            if self.is_interrupted(bag) {
                self.partial_checksum = Some(checksum);
                return Ok(None);
            }
            // A signal ends the process between two pieces.
            yield_now().await;
        }
        checksum.text(bytes).map(Some)
    }

    /// Returns whether the destination has the manifest, and each file in its size.
    pub(crate) async fn is_confirmed(
        &mut self,
        delivery: &Delivery,
    ) -> Result<bool, DeliveryError> {
        let path = self.path(delivery, manifest::FILE_NAME);
        let text = self.store()?.get(&path).await?;
        if text.as_deref() != delivery.manifest.as_deref().map(str::as_bytes) {
            return Ok(false);
        }
        for file in &delivery.files {
            let path = self.path(delivery, &file.name);
            if self.store()?.size(&path).await? != Some(file.bytes) {
                return Ok(false);
            }
        }
        Ok(true)
    }

    fn finish(&mut self, bag: &Bag, mut delivery: Delivery) -> Result<Step, DeliveryError> {
        delivery.is_delivered = true;
        for file in &mut delivery.files {
            file.is_sent = true;
            file.is_delivered = true;
            file.upload = None;
        }
        self.records.keep(&bag.name, delivery);
        Ok(Step::Delivered)
    }

    fn destination(&self) -> Destination {
        Destination {
            url: self.settings.store.url.clone(),
            endpoint: self.settings.store.endpoint.clone(),
            instance: self.settings.instance.clone(),
        }
    }

    /// Returns the path of a file of a bag at the destination.
    fn path(&self, delivery: &Delivery, file: &str) -> Path {
        let bag = delivery.remote.as_deref().unwrap_or_default();
        let robot = self.settings.instance.as_str();
        self.prefix.clone().join(robot).join(bag).join(file)
    }

    /// Returns warnings and errors of the agent in the time of a bag.
    async fn findings_of(&self, bag: &Bag) -> Option<Vec<serde_json::Value>> {
        let (start, end) = bag.content.times?;
        let findings = self.findings.clone()?;
        spawn_blocking(move || findings(start, end)).await.ok()?
    }
}

/// Sends the next part of a file, or completes its upload.
async fn send_part(
    store: &Store,
    path: &Path,
    source: &FilePath,
    file: &mut FileDelivery,
) -> Result<(), DeliveryError> {
    let Some(upload) = &mut file.upload else {
        file.upload = Some(Upload {
            id: store.begin(path).await?,
            part_bytes: part_bytes(file.bytes),
            parts: Vec::new(),
        });
        return Ok(());
    };
    let begin = upload.part_bytes * upload.parts.len() as u64;
    let length = upload.part_bytes.min(file.bytes.saturating_sub(begin));
    let sent = match length {
        0 => store.complete(path, &upload.id, &upload.parts).await,
        _ => {
            let content = read_part(source, begin, length)?;
            let number = upload.parts.len();
            let part = store.put_part(path, &upload.id, number, content).await;
            part.map(|part| upload.parts.push(part))
        }
    };
    match sent {
        Ok(()) => {
            file.is_sent = length == 0;
            Ok(())
        }
        Err(error) => {
            let is_gone = match &error {
                StoreError::Missing(_) => true,
                StoreError::Refused { status, .. } => {
                    length == 0 && *status == hyper::StatusCode::BAD_REQUEST
                }
                _ => false,
            };
            // A process may be killed between the completion of an upload and its record.
            if is_gone && length == 0 && store.size(path).await? == Some(file.bytes) {
                file.is_sent = true;
                return Ok(());
            }
            // The store has dropped the upload: the file begins again.
            if is_gone {
                file.upload = None;
            }
            Err(error.into())
        }
    }
}

/// Returns the size of the parts of a file: whole mebibytes, so that the parts do not exceed the
/// maximum number.
const fn part_bytes(file: u64) -> u64 {
    let least = file.div_ceil(MAX_PARTS).div_ceil(1 << 20) << 20;
    match least > PART_BYTES {
        true => least,
        false => PART_BYTES,
    }
}

/// Reads a part of a file. The file must have all of it.
fn read_part(path: &FilePath, begin: u64, length: u64) -> Result<Bytes, DeliveryError> {
    let read = || {
        let mut file = File::open(path)?;
        file.seek(SeekFrom::Start(begin))?;
        let mut content = Vec::new();
        file.take(length).read_to_end(&mut content)?;
        Ok(content)
    };
    let content: Vec<u8> = read().map_err(|error| DeliveryError::Read(path.to_owned(), error))?;
    match content.len() as u64 == length {
        true => Ok(content.into()),
        false => Err(DeliveryError::Changed),
    }
}

impl PartialChecksum {
    fn new(path: PathBuf, fingerprint: Fingerprint) -> Self {
        Self {
            path,
            fingerprint,
            digest: Sha256::new(),
            bytes: 0,
        }
    }

    /// Opens the file at the first byte that was not read.
    fn open(&self) -> Result<File, DeliveryError> {
        let open = || {
            let mut file = File::open(&self.path)?;
            file.seek(SeekFrom::Start(self.bytes))?;
            Ok(file)
        };
        open().map_err(|error| DeliveryError::Read(self.path.clone(), error))
    }

    /// Reads the next piece. Returns whether another one may follow.
    fn read(&mut self, file: &mut File, buffer: &mut [u8]) -> Result<bool, DeliveryError> {
        let length = file.read(buffer);
        let length = length.map_err(|error| DeliveryError::Read(self.path.clone(), error))?;
        self.digest.update(buffer.get(..length).unwrap_or_default());
        self.bytes += length as u64;
        Ok(length > 0)
    }

    /// Returns the checksum of a file of this size, in hexadecimal digits.
    fn text(self, bytes: u64) -> Result<String, DeliveryError> {
        if self.bytes != bytes {
            return Err(DeliveryError::Changed);
        }
        let digest = self.digest.finalize();
        Ok(digest.iter().map(|byte| format!("{byte:02x}")).collect())
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn a_file_of_any_size_has_a_permitted_number_of_parts(bytes in 1_u64..(1 << 42)) {
            let part = part_bytes(bytes);
            prop_assert!(part >= PART_BYTES && part.is_multiple_of(1 << 20));
            prop_assert!(bytes.div_ceil(part) <= MAX_PARTS);
        }
    }

    #[test]
    fn a_file_of_an_unexpected_size_has_no_checksum() {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), "abc").unwrap();
        let checksum = |bytes| {
            let path = file.path().to_owned();
            let mut checksum = PartialChecksum::new(path, Fingerprint::default());
            // It is interrupted after each byte.
            while checksum.read(&mut checksum.open()?, &mut [0])? {}
            checksum.text(bytes)
        };
        let expected = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";
        assert_eq!(checksum(3).unwrap(), expected);
        assert!(matches!(checksum(4), Err(DeliveryError::Changed)));
        assert!(matches!(
            read_part(file.path(), 1, 3),
            Err(DeliveryError::Changed)
        ));
        assert_eq!(read_part(file.path(), 1, 2).unwrap(), "bc");
    }
}
