"""From a scan file to the interior surface of the socket."""
