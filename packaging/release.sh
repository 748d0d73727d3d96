#!/usr/bin/env bash
# Makes what a maintainer publishes, in target/publish. The files of `make dist` come first. The
# others are wheels, sources of the packages for ROS, and an archive of manifests and the Ansible role.
# An image, a Helm chart, crates and a repository for apt follow. Notes, provenance, checksums and
# signatures describe them.
#
#   packaging/release.sh             sign with the keys of the maintainers
#   packaging/release.sh --trial     sign with keys that are deleted afterwards
#   packaging/release.sh --keys      check that the keys exist, and make nothing
#   packaging/release.sh --again     make all files but the signed ones a second time, in a copy of the
#                                    sources in another directory, and compare the checksums
#
# MINISIGN_SECRET_KEY and APT_SIGNING_KEY name the files of the secret keys. MINISIGN_PASSWORD and
# APT_SIGNING_PASSPHRASE unlock them; without MINISIGN_PASSWORD, minisign prompts for it.
# APT_POOL names a folder with packages of earlier releases, which the repository keeps.
#
# All but apt/ and the signature of SHA256SUMS depends only on target/dist and the commit. Needs the
# tools that `.ci/prerequisites.sh release` installs.
set -euo pipefail
root=$(cd "$(dirname "$0")/.." && pwd -P)
cd "$root"

step() { printf '\n== %s\n' "$*" >&2; }
die() {
    printf 'release: %s\n' "$*" >&2
    exit 1
}

export LC_ALL=C TZ=UTC
umask 022
target=$(realpath -m "${CARGO_TARGET_DIR:-target}")
dist=$target/dist out=$target/publish
version=$(sed -n '/^\[workspace.package\]/,/^\[/s/^version = "\(.*\)"/\1/p' Cargo.toml)
packages=("$dist/ros2probe_${version}"_{amd64,arm64}.deb)
trial=
private=$(mktemp -d)
trap 'rm -rf "$private"' EXIT

keys() {
    if [ -n "$trial" ]; then
        step "keys for a trial"
        minisign -G -f -W -s "$private/minisign.key" -p "$private/minisign.pub" >/dev/null
        export MINISIGN_SECRET_KEY=$private/minisign.key
        unset MINISIGN_PASSWORD
    fi
    [ -f "${MINISIGN_SECRET_KEY-}" ] ||
        die "MINISIGN_SECRET_KEY must name the file of minisign's secret key, which signs SHA256SUMS" \
            "(a trial without keys of your own: make release TRIAL=1)"
    [ -n "$trial" ] || [ -f "${APT_SIGNING_KEY-}" ] ||
        die "APT_SIGNING_KEY must name the file of gpg's exported secret key, which signs the repository for apt" \
            "(a trial without keys of your own: make release TRIAL=1)"
}

# The trusted comment of the signature has the version and the commit.
sign() {
    local options=(-S -s "$MINISIGN_SECRET_KEY" -m "$out/SHA256SUMS" -t "ros2probe $version, commit $commit")
    if [ -n "${MINISIGN_PASSWORD-}" ]; then
        minisign "${options[@]}" <<<"$MINISIGN_PASSWORD" >/dev/null
        minisign -R -s "$MINISIGN_SECRET_KEY" -p "$out/minisign.pub" <<<"$MINISIGN_PASSWORD" >/dev/null
    else
        minisign "${options[@]}" >/dev/null
        minisign -R -s "$MINISIGN_SECRET_KEY" -p "$out/minisign.pub" >/dev/null
    fi
}

# Prints the section of this version in the changelog, or else the unreleased one.
notes() {
    local heading="## $version - "
    grep -q "^$heading" CHANGELOG.md || heading="## Unreleased"
    printf '# ros2probe %s\n' "$version"
    awk -v heading="$heading" '/^## / { inside = index($0, heading) == 1; next } inside' CHANGELOG.md
}

# The commit, whose sources are those of target/dist.
sources() {
    commit=$(git rev-parse HEAD 2>/dev/null) || die "the provenance needs the commit: run this in a clone with git"
    SOURCE_DATE_EPOCH=$(git log -1 --format=%ct)
    export SOURCE_DATE_EPOCH
    local made tags
    made=$(sed -n 's/^    "timestamp": "\(.*\)",$/\1/p' "$dist/rp-$version-x86_64.cdx.json" 2>/dev/null) ||
        die "$dist has no release of version $version: run make dist"
    [ "$(date --date="$made" +%s)" = "$SOURCE_DATE_EPOCH" ] ||
        die "$dist was made of other sources ($made): run make dist"
    (cd "$dist" && sha256sum --check --strict --quiet SHA256SUMS) || die "$dist has changed: run make dist"
    tags=$(git tag --points-at HEAD 'v*')
    [ -z "$tags" ] || grep -qx "v$version" <<<"$tags" || die "the commit has the tag $tags, but its version is $version"
    [ -z "$(git status --porcelain)" ] || [ -n "$trial" ] ||
        die "the sources have changes that are not committed: the provenance would name the wrong commit"
}

# Makes all files that need no key.
files() {
    local package
    sources
    rm -rf "$out"
    mkdir -p "$out"
    cp -a "$dist/." "$out"
    rm "$out/SHA256SUMS"

    step "Python wheels"
    for package in "${packages[@]}"; do packaging/wheel.py "$package" "$out" >&2; done

    step "packages for ROS"
    packaging/ros.sh "$out"

    step "manifests, Ansible role and compose file"
    packaging/deploy.sh "$out"

    step "OCI image"
    packaging/image.py "$out/ros2probe-$version-image.tar" "$commit" "${packages[@]}"

    step "Helm chart"
    tar --create --directory deploy/helm --sort=name --mtime="@$SOURCE_DATE_EPOCH" --owner=0 --group=0 \
        --numeric-owner --mode=u=rwX,go=rX ros2probe | gzip -9n >"$out/ros2probe-$version.tgz"

    step "crates, each built from its packed files"
    rm -rf "$target/crates/package"
    cargo package --workspace --exclude ros2probe-testing --locked ${trial:+--allow-dirty} "$@" \
        --target-dir "$target/crates" >&2
    cp "$target"/crates/package/*.crate "$out"

    step "notes, feed and provenance"
    notes >"$out/RELEASE-NOTES.md"
    packaging/feed.py "$version" "$commit" "$out" >"$private/feed"
    install -m 644 "$private/feed" "$out/release.json"
    packaging/provenance.py "$commit" "$out" >"$private/provenance"
    install -m 644 "$private/provenance" "$out/ros2probe-$version.provenance.json"

    step "checksums"
    (cd "$out" && find . -type f -printf '%P\0' | sort -z | xargs -0 sha256sum) >"$private/sums"
    install -m 644 "$private/sums" "$out/SHA256SUMS"
}

# Makes the files of the same target/dist in a copy of the sources. Its crates are not built again.
again() {
    local there=$private/elsewhere/with-another-name
    [ -f "$out/SHA256SUMS" ] || die "$out has no release: run make release"
    git clone --quiet --no-checkout "$root" "$there"
    git -C "$there" reset --quiet
    # With the changes of a trial.
    git ls-files -z --cached --others --exclude-standard | tar -c --null --files-from=- | tar -x -C "$there"
    mkdir "$there/target"
    cp -a "$dist" "$there/target"
    env -u CARGO_TARGET_DIR "$there/packaging/release.sh" --unsigned
    step "comparing both releases"
    diff "$out/SHA256SUMS" "$there/target/publish/SHA256SUMS" >&2 || die "the two releases differ"
}

release() {
    files
    step "signature of the checksums, by minisign"
    sign

    step "repository for apt, signed by gpg"
    if [ -n "${APT_POOL-}" ]; then packages+=("$APT_POOL"/ros2probe_*.deb); fi
    packaging/repository.sh ${trial:+--trial} "$out/apt" "${packages[@]}"

    find "$out" -maxdepth 1 -type f -printf '%10s %f\n' | sort -k2 >&2
    if [ -n "$trial" ]; then
        printf 'release: the keys of this trial are deleted: do not publish %s\n' "$out" >&2
        echo "The keys that signed these files are deleted." >"$out/DO-NOT-PUBLISH"
    fi
}

# bash reads this line to its end before it runs: the file may change during the build.
case ${1-} in
'')
    keys
    release
    ;;
--trial)
    trial=yes
    keys
    release
    ;;
--keys) keys ;;
--again) again ;;
--unsigned)
    trial=yes
    files --no-verify
    ;;
*) die "usage: packaging/release.sh [--trial|--keys|--again]" ;;
esac; exit
