#!/usr/bin/env bash
# Makes a signed repository for apt, which any web server can serve as it is.
#
#   packaging/repository.sh [--trial] DIRECTORY PACKAGE...
#
# DIRECTORY gets the suite "stable" with the component "main". APT_SIGNING_KEY names the exported
# secret key (`gpg --export-secret-keys`), and APT_SIGNING_PASSPHRASE is its passphrase, if it has
# one. --trial signs with a key that is deleted afterwards. The public key becomes
# DIRECTORY/ros2probe.asc. The index depends only on the packages and
# SOURCE_DATE_EPOCH; its signature contains the current time.
set -euo pipefail

die() {
    printf 'repository.sh: %s\n' "$*" >&2
    exit 1
}

trial=
[ "${1-}" != --trial ] || { trial=yes && shift; }
[ $# -ge 2 ] || die "usage: repository.sh [--trial] DIRECTORY PACKAGE..."
[ -n "$trial" ] || [ -f "${APT_SIGNING_KEY-}" ] || die "APT_SIGNING_KEY must name the file of gpg's exported secret key"
out=$1
shift
export LC_ALL=C TZ=UTC
umask 022

pool=pool/main/r/ros2probe
rm -rf "$out"
mkdir -p "$out/$pool"
install -m 644 "$@" "$out/$pool"

# The operator's keys are neither used nor changed.
GNUPGHOME=$(mktemp -d)
export GNUPGHOME
trap 'gpgconf --kill all; rm -rf "$GNUPGHOME"' EXIT
# The passphrase reaches gpg through a pipe: arguments are visible to other processes.
gpg_() {
    gpg --batch --quiet --no-tty --pinentry-mode loopback --passphrase-fd 3 "$@" 3<<<"${APT_SIGNING_PASSPHRASE-}"
}
if [ -n "$trial" ]; then
    unset APT_SIGNING_PASSPHRASE
    gpg_ --quick-generate-key "Trial of a release <trial@invalid>" ed25519 sign 1d
else
    gpg_ --import "$APT_SIGNING_KEY" || die "gpg cannot read the secret key in $APT_SIGNING_KEY"
fi

cd "$out"
suite=dists/stable
for architecture in amd64 arm64; do
    index=$suite/main/binary-$architecture
    mkdir -p "$index"
    for package in "$pool"/*_"$architecture".deb; do
        [ -f "$package" ] || die "no package is for $architecture"
        apt-ftparchive -o APT::FTPArchive::MD5=false -o APT::FTPArchive::SHA1=false packages "$package"
    done >"$index/Packages"
    gzip -9nk "$index/Packages"
done
apt-ftparchive -o APT::FTPArchive::MD5=false -o APT::FTPArchive::SHA1=false \
    -o APT::FTPArchive::Release::Origin=ros2probe -o APT::FTPArchive::Release::Label=ros2probe \
    -o APT::FTPArchive::Release::Suite=stable -o APT::FTPArchive::Release::Codename=stable \
    -o APT::FTPArchive::Release::Architectures="amd64 arm64" -o APT::FTPArchive::Release::Components=main \
    release "$suite" |
    sed "s/^Date: .*/Date: $(date --date="@$SOURCE_DATE_EPOCH" '+%a, %d %b %Y %H:%M:%S UTC')/" >Release
mv Release "$suite"
gpg_ --armor --detach-sign --output "$suite/Release.gpg" "$suite/Release"
gpg_ --clearsign --output "$suite/InRelease" "$suite/Release"
gpg_ --armor --export >ros2probe.asc
