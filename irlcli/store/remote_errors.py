"""What fsspec and its protocols raise, as errors that name the URL and say what to do."""

from irlcli.errors import IrlError, NotFound, StageFailed, UsageError, first_line


def explained(error: Exception, url: str) -> IrlError:
    """What to raise instead of ``error``, which came from the protocol of ``url``."""
    # Protocols raise classes of their own, which must not be imported: known by their names.
    kinds = {kind.__name__ for kind in type(error).__mro__}
    protocol = url.partition("://")[0]
    text = first_line(error)
    if isinstance(error, ValueError) and text.startswith("Protocol not known"):
        return UsageError(
            f"{url}: the protocol {protocol!r} is unknown",
            "name a directory, or a URL such as s3://BUCKET/PATH",
        )
    if isinstance(error, ImportError):
        extra = "in irlcli's checkout: pip install '.[s3]'" if protocol in ("s3", "s3a") else text
        return UsageError(f"{url}: the package for {protocol!r} is not installed", extra)
    if kinds & {"NoCredentialsError", "PartialCredentialsError", "CredentialRetrievalError"}:
        return UsageError(
            f"{url}: no credentials were found",
            "set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or AWS_PROFILE (docs/sharing.md)",
        )
    if isinstance(error, TypeError) and "__init__()" in text:
        # The protocol's class needs arguments that a URL does not give.
        return UsageError(
            f"{url}: {protocol!r} needs more than a URL ({text})",
            "name a directory, or a URL such as s3://BUCKET/PATH",
        )
    if "ParamValidationError" in kinds:
        return UsageError(
            f"{url} is not a valid URL ({' '.join(str(error).split())})",
            "write PROTOCOL://BUCKET/PATH",
        )
    if isinstance(error, PermissionError):
        return UsageError(
            f"{url}: access is denied ({text})", "check the credentials and their rights"
        )
    if isinstance(error, FileNotFoundError):
        return NotFound(
            f"{url}: not found ({text})", "check the URL; a bucket must exist before a push"
        )
    return StageFailed(
        f"{url}: {type(error).__name__}: {text}",
        "check the URL and the connection, and run the same command again: what arrived is kept",
    )
