# NOT BUILT HERE: where this file was written there is no Docker to build it with. CI checks its text with hadolint; the first
# build is yours. docs/quickstart.md says how to use it.
#
#   docker build -t wlr_gym .
#   docker run --rm -v "$PWD/results:/results/out" wlr_gym demo --quick
FROM python:3.11-slim-bookworm

# What MuJoCo draws pictures with, on a GPU's driver (EGL) or on the processor (OSMesa): Debian 12 has all of it.
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install -y --no-install-recommends libegl1 libgl1 libgl1-mesa-dri libosmesa6 \
    && rm -rf /var/lib/apt/lists/*

RUN useradd --create-home --uid 1000 wlr \
    && mkdir -p /results/out /home/wlr/.cache \
    && chown -R wlr:wlr /results /home/wlr/.cache
WORKDIR /source
COPY . /source
RUN pip install --no-cache-dir -c constraints.txt ".[demo,vision,video,export,logs]"

# Nothing runs as root. Compiled kernels stay in the cache: keep it in a volume, or the first step of each container compiles.
USER 1000
WORKDIR /results
ENV MUJOCO_GL=osmesa \
    MPLBACKEND=agg \
    OMP_NUM_THREADS=1 \
    WLR_GYM_CACHE=/home/wlr/.cache/wlr_gym
ENTRYPOINT ["wlr"]
CMD ["--help"]
