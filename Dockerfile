# Images without PyTorch: `base` is the program, `peers` adds the other programs of `lidarslam compare`.
ARG PYTHON=3.12

FROM python:${PYTHON}-slim-bookworm AS wheel
WORKDIR /source
COPY . .
RUN pip wheel --no-cache-dir --no-deps --wheel-dir /wheels .

FROM python:${PYTHON}-slim-bookworm AS base
COPY scripts/system_libraries.sh constraints.txt /tmp/
RUN sh /tmp/system_libraries.sh && rm -rf /var/lib/apt/lists/*
COPY --from=wheel /wheels /wheels
RUN pip install --no-cache-dir --constraint /tmp/constraints.txt /wheels/*.whl \
 && python -m lidarslam.pipeline.compile_ahead
RUN useradd --uid 1000 --create-home lidarslam && install --directory --owner lidarslam /data
USER 1000
WORKDIR /data
VOLUME /data
ENTRYPOINT ["lidarslam"]
CMD ["--help"]

FROM base AS peers
USER 0
RUN pip install --no-cache-dir --constraint /tmp/constraints.txt "$(echo /wheels/*.whl)[peers]"
USER 1000
