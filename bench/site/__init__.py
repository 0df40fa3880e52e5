"""Published results as a static site: pages that work from a folder of files, without a server and without scripts."""
