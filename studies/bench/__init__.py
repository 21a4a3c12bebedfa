"""Speed and accuracy measurements of this machine: paired with the peer, interleaved, with their spread."""
