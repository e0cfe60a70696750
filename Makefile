# Two commands: `make demo` and `make test`. Each sets up what it needs, inside the checkout.

VENV := .venv
BIN := $(VENV)/bin
# The ROS wheels exist for Python 3.11 to 3.13: the first of these that is one of them.
FITS := "import sys, venv, ensurepip; assert (3, 11) <= sys.version_info[:2] <= (3, 13)"
PYTHON ?= $(shell for p in python3.11 python3.12 python3.13 python3; do \
	$$p -c $(FITS) 2>/dev/null && command -v $$p && break; done)
REQUIREMENTS := $(addprefix requirements/,ros.txt runtime.txt hardware.txt dev.txt)
PIP := $(BIN)/pip --disable-pip-version-check --quiet

# Another ROS environment, sourced or of wheels, must not leak into this one.
unexport PYTHONPATH AMENT_PREFIX_PATH CMAKE_PREFIX_PATH COLCON_PREFIX_PATH LD_LIBRARY_PATH
unexport _ROS_WHEELS_BOOTSTRAP_COMPLETE
# Each node is a process of its own: kept bytecode starts it sooner.
unexport PYTHONDONTWRITEBYTECODE

.DELETE_ON_ERROR:
.PHONY: demo test quick oldest test-slow mutants docs setup lint types style benchmark colcon clean

demo: setup
	$(BIN)/socket-testbed demo

# Side by side, a module at a time: one worker more than two cores where graphs wait.
PYTEST := $(BIN)/python -m pytest --dist loadfile --no-loadscope-reorder --durations 15

test: lint
	$(PYTEST) -n 3 -m "not slow"

# No graph, no processes, no long case: while you work.
quick: setup
	$(PYTEST) -n 2 -m "not graph and not long and not slow"

# The same in a fresh checkout, with the oldest libraries that requirements/runtime.txt allows.
oldest: build/oldest.txt
	PIP_CONSTRAINT=$< $(MAKE) quick

build/oldest.txt: requirements/runtime.txt
	mkdir -p $(@D)
	sed -nE 's/^([A-Za-z][A-Za-z0-9.-]*)>=([0-9.]+).*/\1==\2/p' $< > $@

# The rest: packages, the documents' commands, kills, whole reports, real scans, statistics, OpenSim.
test-slow: setup
	$(PIP) install -r requirements/opensim.txt
	$(PYTEST) -n 3 -m slow

# Small changes that no test notices, as in MUTANTS="socket_testbed/geometry --count 10".
mutants: setup
	$(BIN)/python scripts/mutants.py $(MUTANTS)

# mypy beside the others: it takes as long as all of them.
lint: setup
	@$(MAKE) --no-print-directory --jobs 2 --output-sync types style

types:
	$(BIN)/mypy

style:
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/oxlint --deny-warnings --report-unused-disable-directives \
		socket_testbed/pages/static test/support
	$(BIN)/python scripts/check_docstrings.py

# The reference of the Python API and of all types that it takes or returns, from the docstrings.
DOCUMENTED := api arrays calibration errors geometry identification pages.server report.results results \
	figures.style samples settings simulation.limb socket_design tables trials
docs: setup
	$(BIN)/pdoc --docformat google --output-directory build/docs $(addprefix socket_testbed.,$(DOCUMENTED))
	@echo "open build/docs/socket_testbed/api.html, or build/docs/index.html for all modules"

setup: $(VENV)/.messages $(VENV)/.package

benchmark: setup
	$(PIP) install -r requirements/benchmarks.txt
	$(BIN)/python benchmarks/benchmark_fit.py
	$(BIN)/python benchmarks/benchmark_long_trials.py
	$(BIN)/python benchmarks/benchmark_drivers.py
	$(BIN)/python benchmarks/benchmark_force_map.py

# The same sources as an ordinary colcon workspace, here with the ROS wheels. colcon calls the
# generators of ROS in the folder itself, where they fail over a space or an umlaut.
colcon: $(VENV)/.packages
	@LC_ALL=C; case "$(CURDIR)" in *[!A-Za-z0-9._/+-]*) \
		echo "error: colcon cannot build in $(CURDIR): move the checkout to a path of plain letters without spaces"; \
		exit 1;; esac
	AMENT_PREFIX_PATH=$(CURDIR)/$(VENV) CMAKE_PREFIX_PATH=$(CURDIR)/$(VENV) \
		PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/colcon build

$(VENV)/.packages: $(wildcard requirements/*.txt) scripts/fix_ros_wheels.py
	@test -n "$(PYTHON)" || { echo "error: no Python 3.11, 3.12 or 3.13 with venv: install one, or give PYTHON=..."; exit 1; }
	@test "$$(uname -m)" = x86_64 || { echo "error: the ROS wheels are for x86-64: on $$(uname -m) use a ROS installation (README)"; exit 1; }
	@echo "setting up $(VENV) with $(PYTHON) (about two minutes, once)"
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@( $(PIP) install "setuptools>=65,<80" wheel && $(PIP) install $(addprefix -r ,$(REQUIREMENTS)) ) \
		> $(VENV)/pip.log 2>&1 || { tail -n 30 $(VENV)/pip.log; exit 1; }
	@$(BIN)/python scripts/fix_ros_wheels.py
	@touch $@

# The message packages, built by CMake as colcon would, into the environment as a ROS prefix: our
# own, and tf2_msgs, which no index of wheels has. The generators of ROS fail in a path with a space
# or an umlaut: they run behind a link from a temporary folder, which goes when the shell ends.
MESSAGES := msg_defs requirements/tf2_msgs
$(VENV)/.messages: $(VENV)/.packages $(foreach m,$(MESSAGES),$(m)/CMakeLists.txt $(m)/package.xml $(wildcard $(m)/msg/*.msg))
	@echo "building the messages"
	@rm -rf $(VENV)/messages
	@linked=$$(mktemp -d) && trap 'rm -r "$$linked"' EXIT \
	&& here=$$linked/checkout && ln -s "$(CURDIR)" "$$here" \
	&& export AMENT_PREFIX_PATH="$$here/$(VENV)" CMAKE_PREFIX_PATH="$$here/$(VENV)" \
		PATH="$$here/$(BIN):$$PATH" \
	&& ( for package in $(MESSAGES); do \
		build=$$here/$(VENV)/messages/$$(basename $$package); \
		cmake -S "$$here/$$package" -B "$$build" -DBUILD_TESTING=OFF \
			-DCMAKE_INSTALL_PREFIX="$$here/$(VENV)" -DPython3_EXECUTABLE="$$here/$(BIN)/python" \
		&& cmake --build "$$build" -j 2 && cmake --install "$$build" || exit 1; \
	done; \
	grep -rIlZ "$$linked" $(VENV)/share | xargs -0 sed -i "s|$$here|$(CURDIR)|g" ) \
		> $(VENV)/messages.log 2>&1 || { tail -n 30 $(VENV)/messages.log; exit 1; }
	@touch $@

$(VENV)/.package: $(VENV)/.packages setup.py setup.cfg
	@$(PIP) install --no-build-isolation --no-deps --editable . > $(VENV)/pip.log 2>&1 \
		|| { tail -n 30 $(VENV)/pip.log; exit 1; }
	@touch $@

clean:
	rm -rf $(VENV) build install log demo
