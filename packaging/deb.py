"""Reads a Debian package of rp: wheels and images are made of its files."""
import io
import subprocess
import tarfile
from email.parser import Parser

# Of the package's files, those that every form of rp contains.
PROGRAM = "usr/bin/rp"
CONFIGURATION = "etc/ros2probe/ros2probe.yaml"
COPYRIGHT = "usr/share/doc/ros2probe/copyright"
LIBRARIES = "usr/share/doc/ros2probe/libraries.gz"


class Package:
    """The fields and the files of a package."""

    def __init__(self, path):
        control = subprocess.run(["dpkg-deb", "--field", path], check=True, stdout=subprocess.PIPE, text=True)
        files = subprocess.run(["dpkg-deb", "--fsys-tarfile", path], check=True, stdout=subprocess.PIPE)
        self.fields = Parser().parsestr(control.stdout)
        self.version = self.fields["Version"]
        self.architecture = self.fields["Architecture"]
        self._files = tarfile.open(fileobj=io.BytesIO(files.stdout))

    def read(self, path):
        """Returns the content of a file. Raises KeyError if the package does not have it."""
        return self._files.extractfile("./" + path).read()
