# Each target first names and installs what it needs and this machine lacks (.ci/prerequisites.sh).
SHELL := /bin/bash
.DEFAULT_GOAL := help

TARGET := $(abspath $(or $(CARGO_TARGET_DIR),target))
SUDO := $(if $(filter 0,$(shell id -u)),,sudo -E)
CORPUS := $(abspath $(or $(ROS2PROBE_FIXTURES),../shared/fixtures))
# The released target for this machine.
SHIPPED := $(shell uname -m)-unknown-linux-musl
HOST := $(shell rustc -vV 2>/dev/null | sed -n 's/^host: //p' | tr 'a-z-' 'A-Z_')

# Miri runs unoptimized code: few random cases, and a separate build directory.
MIRI := MIRIFLAGS="-Zmiri-strict-provenance -Zmiri-disable-isolation $$MIRI_MORE" PROPTEST_CASES=4 \
    CARGO_TARGET_DIR=$(TARGET)/miri cargo "+$$(.ci/prerequisites.sh --nightly)" miri test
# Floods and tests that change every byte would take hours under Miri, and queues wake their readers
# through sockets, which it does not support.
MIRI_WIRE := cursor:: walk:: record:: rtps:: testing:: --skip never
MIRI_CAPTURE := ring::block ring::turns shm::cell shm::port shm::segment shm::inbox
MIRI_THREADS := ring::turns

SOURCES := https://github.com/ros2probe/ros2probe/blob/main

# Tests and demo select the whole workspace: a part of it has other features, so its dependencies
# would be built again.

# target/tools has Node only if the system's is too old for the page's tests.
export PATH := $(TARGET)/tools/node/bin:$(PATH):$(HOME)/.cargo/bin:$(TARGET)/tools/usr/bin
# A part of Rust that links for both architectures: no cross toolchain is needed.
export CARGO_TARGET_AARCH64_UNKNOWN_LINUX_MUSL_LINKER := rust-lld
# The C of ring needs no library: clang compiles it for both architectures.
export CC_x86_64_unknown_linux_musl := clang
export CC_aarch64_unknown_linux_musl := clang
# The tests make network namespaces: build as the user, run the tests as root.
ifneq ($(SUDO),)
export CARGO_TARGET_$(HOST)_RUNNER := $(SUDO) env PATH=$(PATH)
endif

help: ## this list
	@sed -n 's/^\([a-z0-9-]*\):.*## /\1\t/p' $(MAKEFILE_LIST) | expand -t 16

demo: ## watch a small robot, no ROS needed; DEMO_SECONDS=N ends it (needs root)
	@.ci/prerequisites.sh demo
	cargo build --workspace --bin rp --example robot --example demo
	@$(SUDO) $(TARGET)/debug/examples/demo $(if $(DEMO_SECONDS),--seconds $(DEMO_SECONDS))

fleet: ## watch three robots and their centre with real engines; FLEET_SECONDS=N ends it (needs root)
	@.ci/prerequisites.sh fleet
	cargo build --workspace --bin rp --example robot --example fleet
	@$(SUDO) env PATH=$(PATH) $(TARGET)/debug/examples/fleet $(if $(FLEET_SECONDS),--seconds $(FLEET_SECONDS))

fleet-bench: AGENTS ?= 10,50,100
fleet-bench: ## what Prometheus and VictoriaMetrics need for AGENTS (10,50,100) agents
	@.ci/prerequisites.sh fleet
	cargo build --release --workspace --example fleet_load
	$(TARGET)/release/examples/fleet_load --agents $(AGENTS)

test: ## format, spelling, lints, kernel object, and all tests with real DDS participants (needs root)
	@.ci/prerequisites.sh test
	cargo fmt --all --check
	$(TARGET)/tools/typos/bin/typos
	cargo clippy --workspace --all-targets -- -D warnings
	NIGHTLY=$$(.ci/prerequisites.sh --nightly) agent-ebpf/build.sh --check
	@$(MAKE) --no-print-directory page
	@$(MAKE) --no-print-directory peers
	@$(MAKE) --no-print-directory arm
	cargo build --workspace --bins --examples
	cargo test --workspace --doc --quiet
	cargo nextest run --workspace --no-run
	@sync # An fsync in a test would wait until all that the build wrote is on the disk.
	cargo nextest run --workspace $$(.ci/prerequisites.sh --left-out)
	@.ci/prerequisites.sh --ros2-summary
	@if [ -d "$(CORPUS)" ]; then $(MAKE) --no-print-directory test-corpus; fi

test-fast: ## unit tests, model and surface, without root and namespaces: under 90 s after a build
	@.ci/prerequisites.sh fast
	@env -u CARGO_TARGET_$(HOST)_RUNNER cargo nextest run --workspace --profile fast

test-corpus: ## tests against the whole corpus of captures in ROS2PROBE_FIXTURES (../shared/fixtures)
	ROS2PROBE_FIXTURES=$(CORPUS) cargo nextest run --workspace --run-ignored only --filterset 'test(corpus)'

test-ros2: ## tests against real nodes and the real ros2 command line of each distribution below /opt/ros, or in ROS2PROBE_ROS2 (needs root)
	@[ -n "$$(.ci/prerequisites.sh --ros2)" ] || { echo "no ROS 2 below /opt/ros: install a distribution, or set ROS2PROBE_ROS2 to its directory" >&2; exit 1; }
	@.ci/prerequisites.sh test
	@for prefix in $$(.ci/prerequisites.sh --ros2); do \
	    echo "tests with the ROS 2 in $$prefix"; \
	    ROS2PROBE_ROS2=$$prefix cargo nextest run --workspace --run-ignored only \
	        --filterset "$$(.ci/prerequisites.sh --ros2-selection $$prefix)" || exit 1; \
	done

bench-ros2: ## what the agent and `ros2 topic hz` cost nodes of rmw_zenoh, and what causes of late calls cost; ROUNDS=N (3) (needs root)
	@.ci/prerequisites.sh test
	ROUNDS=$(or $(ROUNDS),3) cargo test --release --package ros2probe --test ros2 -- --ignored --nocapture cost::

ebpf: ## rebuild the kernel filter's committed object
	@.ci/prerequisites.sh ebpf
	NIGHTLY=$$(.ci/prerequisites.sh --nightly) agent-ebpf/build.sh

run: ## run the agent on this machine with the default configuration (needs root)
	cargo build --release --package ros2probe --bin rp
	$(SUDO) $(TARGET)/release/rp run --config config/ros2probe.yaml

page: ## unit tests of the page, its types, and its libraries compared with what npm publishes
	@.ci/prerequisites.sh types page
	node --test --test-reporter dot agent/page/test/
	agent/page/test/types
	agent/page/vendor/check

page-bench: ## first paint with 500 topics, layout, frames and memory of the page; MEASURE_MINUTES=N (10)
	@.ci/prerequisites.sh page
	cargo build --release --package ros2probe --bin rp
	MEASURE_MINUTES=$(or $(MEASURE_MINUTES),10) cargo test --release --package ros2probe \
	    --test live -- --ignored --exact browser::paint_layout_and_memory_of_the_page_are_measured --nocapture

screenshots: ## the pictures of README and docs, from the demo, in target/screenshots (needs root)
	@.ci/prerequisites.sh demo pictures
	cargo build --workspace --bin rp --example robot --example demo
	$(SUDO) env PATH=$(PATH) node agent/cli/tests/page/screenshots.mjs $(TARGET)/debug/examples/demo $(TARGET)/screenshots

peers: ## build the test peers into target/peers: Fast DDS, Cyclone DDS, dust_dds, RustDDS and HDDS
	@$(MAKE) --no-print-directory -C agent/cli/tests/peers OUT=$(TARGET)/peers all shapes

arm: ## build rp for aarch64, static and unoptimized, which the tests run under qemu
	CARGO_PROFILE_DEV_DEBUG=0 cargo build --package ros2probe --bin rp --target aarch64-unknown-linux-musl

dist: ## release both binaries, packages, bills of materials and checksums into target/dist, tested
	@.ci/prerequisites.sh dist
	packaging/dist.sh
	ROS2PROBE_DIST=$(TARGET)/dist ROS2PROBE_PACKAGES=$(TARGET)/dist cargo test --package ros2probe --test dist -- --include-ignored --skip publish::

release: ## what a maintainer publishes, in target/publish: make dist, wheels, image, chart, crates, apt repository, signed; TRIAL=1 without keys (needs root)
	@.ci/prerequisites.sh release
	@$(if $(TRIAL),,packaging/release.sh --keys)
	@$(MAKE) --no-print-directory dist
	packaging/release.sh $(if $(TRIAL),--trial)
	@$(MAKE) --no-print-directory -C agent/cli/tests/peers OUT=$(TARGET)/peers $(TARGET)/peers/fastdds
	cargo build --package ros2probe --example robot
	ROS2PROBE_DIST=$(TARGET)/publish ROS2PROBE_PACKAGES=$(TARGET)/publish cargo test --package ros2probe --test dist -- --include-ignored publish::

vm: ## boot whole systems, install the package in each and check it; VM="arm64-6.1 ..." chooses (needs root)
	@.ci/prerequisites.sh vm
	@[ -f $(TARGET)/dist/SHA256SUMS ] || $(MAKE) --no-print-directory dist
	@$(SUDO) packaging/vm.sh $(VM)

distcheck: ## repeat the build of make dist in another directory and compare every byte
	packaging/dist.sh --again

bench: ## benchmarks, and the cost of the agent and of a subscriber (needs root)
	@.ci/prerequisites.sh test dist
	cargo bench --workspace
	@$(MAKE) --no-print-directory peers
	cargo build --release --package ros2probe --bin rp --target $(SHIPPED)
	cargo build --release --package ros2probe --example robot --example workloads
	@$(SUDO) $(TARGET)/release/examples/workloads $(BENCH_OPTIONS)

tcp-cost: ## what observing adds to TCP that is neither Zenoh nor RTPS; ROUNDS=N (7) (needs root)
	@.ci/prerequisites.sh test
	cargo build --release --workspace --example zenoh_cost
	@$(SUDO) $(TARGET)/release/examples/zenoh_cost $(or $(ROUNDS),7) 2

cost: ## what observing adds to a workload, with intervals, and the time of each kernel program; COST_OPTIONS="--pairs 100 --load 4" (needs root)
	@.ci/prerequisites.sh test dist
	@$(MAKE) --no-print-directory peers
	cargo build --release --package ros2probe --bin rp --target $(SHIPPED)
	cargo build --release --package ros2probe --example workloads
	@$(SUDO) $(TARGET)/release/examples/workloads --pairs 30 --seconds 2 $(COST_OPTIONS)

soak: ## an hour of a changing graph and faults with the released binary; SOAK_SECONDS=N; results in target/soak (needs root)
	@.ci/prerequisites.sh test dist
	cargo build --release --package ros2probe --bin rp --target $(SHIPPED)
	@mkdir -p $(TARGET)/soak && rm -f $(TARGET)/soak/faults.md
	ROS2PROBE_SOAK=1 ROS2PROBE_SOAK_SECONDS=$(or $(SOAK_SECONDS),3600) \
	    ROS2PROBE_SOAK_PROGRAM=$(TARGET)/$(SHIPPED)/release/rp cargo test --release \
	    --package ros2probe --test live --no-fail-fast -- endurance:: faults:: \
	    --nocapture --test-threads 1 $(if $(ROS2PROBE_SOAK_CLOCK),--include-ignored)
	@cat $(TARGET)/soak/faults.md

fuzz: ## run every fuzz target for FUZZ_SECONDS (60)
	@.ci/prerequisites.sh fuzz
	for crate in wire agent; do (cd $$crate && for target in $$(cargo fuzz list --fuzz-dir fuzz); do \
	    mkdir -p "fuzz/corpus/$$target"; \
	    cargo "+$$(../.ci/prerequisites.sh --nightly)" fuzz run --fuzz-dir fuzz "$$target" "fuzz/corpus/$$target" \
	        $$(ls -d "fuzz/seeds/$$target" "tests/data/$${target}s" 2>/dev/null) -- \
	        -max_total_time=$(or $(FUZZ_SECONDS),60) || exit 1; \
	done) || exit 1; done

miri: ## rings and the walk under Miri, which finds undefined behaviour
	@.ci/prerequisites.sh miri
	@$(MIRI) --package ros2probe-wire --lib -- $(MIRI_WIRE)
	@$(MIRI) --package ros2probe-capture --lib -- $(MIRI_CAPTURE)
	@MIRI_MORE=-Zmiri-many-seeds=0..16 $(MIRI) --package ros2probe-capture --lib -- $(MIRI_THREADS)

book: ## the documentation as a website in target/book, with its links, sizes and prose checked
	@.ci/prerequisites.sh book
	cargo test --workspace --test documents --test prose --quiet
	mdbook build docs --dest-dir $(TARGET)/book
	@# Links out of the book lead to the repository.
	sed -i -E 's#href="\.\./([^"#]*)\.html#href="$(SOURCES)/\1.md#g; s#href="\.\./#href="$(SOURCES)/#g' $(TARGET)/book/*.html

deny: ## licences, sources and known vulnerabilities of dependencies; DENY=bans licenses sources: without network
	@.ci/prerequisites.sh deny
	cargo deny check $(DENY)

prerequisites: ## install what demo, test, dist, ebpf and fuzz need
	@.ci/prerequisites.sh demo test dist ebpf fuzz

.PHONY: help demo fleet fleet-bench test test-fast test-corpus test-ros2 bench-ros2 ebpf run page page-bench screenshots peers arm dist release vm distcheck bench tcp-cost cost soak fuzz miri book deny prerequisites
