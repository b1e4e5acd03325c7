# The page and every command, on a CPU, without root and without weights that are for research only.
# docs/install.md says how it is built and run.
FROM python:3.11-slim

# Where pip finds torch's CPU build; without it, torch comes with GPU libraries of several GB.
ARG PIP_EXTRA_INDEX_URL
ENV PIP_NO_CACHE_DIR=1 PYTHONUNBUFFERED=1

RUN useradd --create-home --uid 1000 depthpose
WORKDIR /opt/depthpose

# torch alone and first: what changes in the sources does not install it again.
COPY constraints.txt ./
RUN pip install -c constraints.txt torch
COPY pyproject.toml README.md LICENSE ./
COPY src ./src
RUN pip install -c constraints.txt '.[serve,opencv]'

USER depthpose
WORKDIR /home/depthpose
EXPOSE 8000
HEALTHCHECK --interval=30s --timeout=10s --start-period=60s --retries=3 \
    CMD ["python", "-c", "from urllib.request import urlopen; urlopen('http://127.0.0.1:8000/', timeout=8)"]
ENTRYPOINT ["depthpose"]
CMD ["serve", "--host", "0.0.0.0", "--port", "8000"]
